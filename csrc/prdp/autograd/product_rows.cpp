#include "prdp/autograd/product_rows.h"

#include <algorithm>

#include "prdp/operators/tensors.h"

namespace prdp {

namespace {
/// Pairs that are summed at once: many of small vectors, where a tensor operation takes longer to call than to run.
int64_t rows_of(int64_t unknowns) { return std::clamp<int64_t>(65536 / std::max<int64_t>(unknowns, 1), 16, 128); }
}  // namespace

ProductRows::ProductRows(std::unique_ptr<Operator> a, const at::Tensor& like) : a_(std::move(a)) {
  auto shape = like.sizes().vec();
  shape[0] = rows_of(like.numel() / std::max<int64_t>(like.size(0), 1));
  lambda_ = at::empty(shape, like.options());
  v_ = at::empty(shape, like.options());
}

void ProductRows::push() {
  if (++count_ == lambda_.size(0)) flush();
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
