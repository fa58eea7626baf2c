#include "prdp/autograd/product_rows.h"

#include "prdp/operators/tensors.h"

namespace prdp {

namespace {
constexpr int64_t kRows = 16;
}

ProductRows::ProductRows(std::unique_ptr<Operator> a, const at::Tensor& like) : a_(std::move(a)) {
  auto shape = like.sizes().vec();
  shape[0] = kRows;
  lambda_ = at::empty(shape, like.options());
  v_ = at::empty(shape, like.options());
}

void ProductRows::push() {
  if (++count_ == kRows) flush();
}

void ProductRows::flush() {
  if (count_ == 0) return;
  const auto products = a_->product_rule(lambda_.narrow(0, 0, count_), v_.narrow(0, 0, count_));
  sums_.resize(products.size());
  for (size_t i = 0; i < products.size(); ++i) add_to(sums_[i], products[i]);
  count_ = 0;
}

std::vector<at::Tensor> ProductRows::finish() {
  flush();
  return std::move(sums_);
}

}  // namespace prdp
