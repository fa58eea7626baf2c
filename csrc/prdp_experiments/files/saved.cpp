#include "prdp_experiments/files/saved.h"

#include <c10/util/Exception.h>

#include <cmath>

#include "prdp/error_text.h"

namespace prdp {

namespace {

void check_values(const std::string& name, const at::Tensor& tensor, const Range& range) {
  if (tensor.numel() == 0 || tensor.scalar_type() == at::kBool) return;
  if (tensor.is_floating_point() || tensor.is_complex()) {
    auto good = tensor.isfinite();
    if (range.unknown_is_nan) good = good.logical_or(tensor.isnan());
    TORCH_CHECK_VALUE(!range.finite || good.all().item<bool>(), "tensor '", name, "' holds NaN or Inf");
  }
  if (tensor.is_complex()) return;
  const auto bounded = [&](double bound, const at::Tensor& beyond, const char* where) {
    TORCH_CHECK_VALUE(!beyond.any().item<bool>(), "tensor '", name, "' holds a value ", where, bound);
  };
  // NaN is neither below nor above.
  if (std::isfinite(range.least)) bounded(range.least, tensor.lt(range.least), "below ");
  if (std::isfinite(range.most)) bounded(range.most, tensor.gt(range.most), "above ");
}

}  // namespace

const at::Tensor& Saved::found(const std::string& name) const {
  const auto entry = tensors_.find(name);
  TORCH_CHECK_VALUE(entry != tensors_.end() && entry->second.defined(), "there is no tensor '", name, "'");
  return entry->second;
}

const at::Tensor& Saved::take(const std::string& name, at::ScalarType dtype, at::IntArrayRef sizes,
                              const Range& range) {
  const auto& tensor = found(name);
  asked_.insert(name);
  TORCH_CHECK_VALUE(tensor.scalar_type() == dtype && tensor.sizes() == sizes, "tensor '", name, "' is ",
                    dtype_name(tensor.scalar_type()), " of sizes ", tensor.sizes(), ", expected ", dtype_name(dtype),
                    " of sizes ", sizes);
  check_values(name, tensor, range);
  return tensor;
}

int64_t Saved::length(const std::string& name) const {
  const auto& tensor = found(name);
  TORCH_CHECK_VALUE(tensor.dim() == 1, "tensor '", name, "' is of sizes ", tensor.sizes(), ", expected a list");
  return tensor.numel();
}

void Saved::restore(const std::string& name, at::Generator generator) {
  const auto now = generator.get_state();
  try {
    generator.set_state(take(name, now.scalar_type(), now.sizes()));
  } catch (const c10::ValueError&) {
    throw;
  } catch (const c10::Error&) {
    TORCH_CHECK_VALUE(false, "tensor '", name, "' is no state of a generator of random numbers");
  }
}

void Saved::finish() const {
  for (const auto& [name, tensor] : tensors_)
    TORCH_CHECK_VALUE(asked_.contains(name), "nobody knows its tensor '", name, "'");
}

}  // namespace prdp
