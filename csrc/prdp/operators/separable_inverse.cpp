#include "prdp/operators/separable_inverse.h"

#include <numeric>

namespace prdp {

namespace {

at::Tensor on_device(const Eigen::MatrixXd& matrix, const at::TensorOptions& options) {
  const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> rows = matrix;
  const auto here = at::from_blob(const_cast<double*>(rows.data()), {rows.rows(), rows.cols()}, at::kDouble).clone();
  return here.to(options.device(), widest_real(options.device()));
}

}  // namespace

at::Tensor along_axes(const at::Tensor& v, at::TensorList matrices, bool transposed) {
  const auto sizes = v.sizes();
  const int64_t last = v.dim() - 1, first = v.dim() - static_cast<int64_t>(matrices.size());
  auto w = v.to(matrices[0].scalar_type()).contiguous();
  for (int64_t axis = last; axis >= first; --axis) {
    const auto& matrix = matrices[axis - first];
    const auto from_left = transposed ? matrix.transpose(0, 1) : matrix;
    const auto each = [](const at::Tensor& m, int64_t count) { return m.unsqueeze(0).expand({count, -1, -1}); };
    // A product for each sample or less: that of all would add up in an order that depends on how many there are.
    if (axis == last) {
      w = at::bmm(w.view({sizes[0], -1, sizes[axis]}), each(from_left.transpose(0, 1), sizes[0]));
    } else {
      const int64_t before = c10::multiply_integers(sizes.slice(0, axis));
      w = at::bmm(each(from_left, before), w.view({before, sizes[axis], -1}));
    }
  }
  return w.view(sizes);
}

at::Tensor InnerBox::of(at::Tensor t) const {
  const auto axes = static_cast<int64_t>(shape.size());
  for (int64_t axis = 0; axis < axes; ++axis) t = t.narrow(t.dim() - axes + axis, first[axis], shape[axis]);
  return t;
}

SeparableInverse::SeparableInverse(const kernels::DiagonalisedSum& a, InnerBox box, const at::TensorOptions& options)
    : box_(std::move(box)) {
  if (!a.inverse) return;
  const auto here = at::tensor(*a.inverse, at::kDouble).view(box_.shape);
  if (a.eigenvectors) {
    for (size_t axis = 3 - box_.shape.size(); axis < 3; ++axis)
      eigenvectors_.push_back(on_device((*a.eigenvectors)[axis], options));
    inverse_ = here.to(options.device(), widest_real(options.device()));
  } else {
    const int64_t kept = box_.shape.back() / 2 + 1;  // of the waves, by a real transform
    inverse_ = here.narrow(-1, 0, kept).contiguous().to(options.dtype()).to(options.device());
  }
}

at::Tensor SeparableInverse::solve(const at::Tensor& b, const at::Tensor& diagonal) const {
  const auto inside = box_.of(b);
  if (inside.sizes() == b.sizes()) return solve_inside(b);
  auto u = b / diagonal;
  box_.of(u).copy_(solve_inside(inside));
  return u;
}

at::Tensor SeparableInverse::solve_inside(const at::Tensor& b) const {
  if (!inverse_.defined()) return at::full_like(b, std::numeric_limits<double>::quiet_NaN());
  if (!eigenvectors_.empty())
    return along_axes(along_axes(b, eigenvectors_, /*transposed=*/true) * inverse_, eigenvectors_, false)
        .to(b.scalar_type());
  std::vector<int64_t> axes(box_.shape.size());
  std::iota(axes.begin(), axes.end(), 2);
  return at::fft_irfftn(at::fft_rfftn(b, std::nullopt, axes) * inverse_, at::IntArrayRef(box_.shape), axes);
}

int64_t SeparableInverse::bytes() const {
  auto sum = static_cast<int64_t>(inverse_.defined() ? inverse_.nbytes() : 0);
  for (const auto& q : eigenvectors_) sum += static_cast<int64_t>(q.nbytes());
  return sum;
}

}  // namespace prdp
