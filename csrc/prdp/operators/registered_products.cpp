#include "prdp/operators/registered_products.h"

#include <mutex>
#include <random>
#include <typeindex>
#include <unordered_map>

#include "prdp/error_text.h"

namespace prdp {

namespace {

struct Registry {
  std::mutex mutex;
  std::unordered_map<int64_t, std::weak_ptr<const RegisteredProducts>> entries;
  /// No process has the numbers of another: torch keeps compiled graphs on disk, with the product of a number in them.
  int64_t last = static_cast<int64_t>(std::random_device()()) << 24;
};

Registry& registry() {
  static auto* all = new Registry;  // outlives every backward thread
  return *all;
}

/// One for each lambda in the source; functions that a pointer points to have one each.
std::shared_ptr<FunctionCode> code_of(const Products::Product& apply) {
  static std::mutex mutex;
  static auto* codes = new std::unordered_map<std::type_index, std::shared_ptr<FunctionCode>>;
  if (apply.target<at::Tensor (*)(const at::Tensor&, const std::vector<at::Tensor>&)>())
    return std::make_shared<FunctionCode>();
  const std::lock_guard lock(mutex);
  auto& code = (*codes)[apply.target_type()];
  if (!code) code = std::make_shared<FunctionCode>();
  return code;
}

}  // namespace

std::shared_ptr<const RegisteredProducts> RegisteredProducts::make(Products products) {
  TORCH_CHECK_VALUE(products.apply, "Function: apply, the product with A, must be given");
  const std::shared_ptr<RegisteredProducts> made(new RegisteredProducts(std::move(products)));
  made->code = code_of(made->products_.apply);
  const std::lock_guard lock(registry().mutex);
  made->number_ = ++registry().last;
  registry().entries[made->number_] = made;
  return made;
}

std::shared_ptr<const RegisteredProducts> RegisteredProducts::find(int64_t number) {
  std::shared_ptr<const RegisteredProducts> found;
  {
    const std::lock_guard lock(registry().mutex);
    const auto entry = registry().entries.find(number);
    if (entry != registry().entries.end()) found = entry->second.lock();
  }
  TORCH_CHECK_VALUE(found, "Function: the operator no longer exists; keep ",
                    in_language("it, and make it outside of what torch.func.linearize or torch.compile runs; "
                                "torch.export does not save it",
                                "its RegisteredProducts"));
  return found;
}

RegisteredProducts::~RegisteredProducts() {
  const std::lock_guard lock(registry().mutex);
  registry().entries.erase(number_);
}

std::shared_ptr<const RegisteredProducts> products_of(const OperatorSpec& a) {
  if (!is_function(a)) return nullptr;
  TORCH_CHECK_VALUE(!a.shape.empty(), "Function: its operator must come from spec() of RegisteredProducts");
  return RegisteredProducts::find(a.shape[0]);
}

}  // namespace prdp
