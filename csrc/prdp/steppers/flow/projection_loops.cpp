#include "prdp/steppers/flow/projection_loops.h"

#include <c10/util/irange.h>

#include "prdp/kernels/flow_points.h"
#include "prdp/steppers/flow/each_sample.h"

namespace prdp {

namespace {

/// The rows along x of a field (z, y, x), and their neighbours; in 2D there is one plane.
class GridRows {
 public:
  explicit GridRows(const FlowBox& box) : box_(box), first_(3 - box.dim()) {
    for (const auto axis : c10::irange(box.dim())) n_[first_ + axis] = box.shape()[axis];
  }
  int64_t length() const { return n_[2]; }
  int64_t cells() const { return n_[0] * n_[1] * n_[2]; }
  /// f(axis of the box, its channel, whether it runs along the rows)
  template <class F>
  void for_each_axis(const F& f) const {
    for (const auto axis : c10::irange(box_.dim())) f(axis, box_.channel_of(axis), axis == box_.dim() - 1);
  }
  /// f(first cell of a row, first cell of the row one cell to a `side`, -1 or 1, along the axis), -1 beyond an end that
  /// is not periodic.
  template <class F>
  void for_each_pair(int64_t axis, int64_t side, const F& f) const {
    const int64_t a = first_ + axis, stride = a == 0 ? n_[1] * n_[2] : n_[2];
    for (const auto z : c10::irange(n_[0]))
      for (const auto y : c10::irange(n_[1])) {
        const int64_t here = (z * n_[1] + y) * n_[2], moved = (a == 0 ? z : y) + side;
        const bool inside = moved >= 0 && moved < n_[a];
        const int64_t wrapped = here + (inside ? side : -side * (n_[a] - 1)) * stride;
        f(here, inside || periodic(axis) ? wrapped : -1);
      }
  }
  bool periodic(int64_t axis) const { return box_.boundary(axis) == FlowBoundary::kPeriodic; }

 private:
  const FlowBox& box_;
  int64_t first_, n_[3]{1, 1, 1};
};

/// out += k (after - here) of one row.
template <class T>
void add_difference(T k, const T* here, const T* after, T* out, int64_t n) {
  for (int64_t i = 0; i < n; ++i) out[i] += kernels::difference(k, here[i], after[i]);
}

template <class T>
void divergence(const FlowBox& box, const T* u, double factor, T* out) {
  const GridRows rows(box);
  const int64_t n = rows.length();
  const std::vector<T> zeros(n);
  std::fill_n(out, rows.cells(), T(0));
  rows.for_each_axis([&](int64_t axis, int64_t channel, bool along) {
    const T* low = u + channel * rows.cells();
    const T k = static_cast<T>(factor / box.dx(axis));
    if (!along)
      return rows.for_each_pair(axis, 1, [&](int64_t at, int64_t next) {
        add_difference(k, low + at, next < 0 ? zeros.data() : low + next, out + at, n);
      });
    for (int64_t at = 0; at < rows.cells(); at += n) {
      add_difference(k, low + at, low + at + 1, out + at, n - 1);
      out[at + n - 1] += kernels::difference(k, low[at + n - 1], rows.periodic(axis) ? low[at] : T(0));
    }
  });
}

template <class T>
void add_gradient(const FlowBox& box, const T* p, double factor, T* u) {
  const GridRows rows(box);
  const int64_t n = rows.length();
  const std::vector<T> zeros(n);
  rows.for_each_axis([&](int64_t axis, int64_t channel, bool along) {
    T* of_axis = u + channel * rows.cells();
    const T k = static_cast<T>(factor / box.dx(axis));
    if (!along)
      return rows.for_each_pair(axis, -1, [&](int64_t at, int64_t before) {
        add_difference(k, before < 0 ? zeros.data() : p + before, p + at, of_axis + at, n);
      });
    for (int64_t at = 0; at < rows.cells(); at += n) {
      of_axis[at] += kernels::difference(k, rows.periodic(axis) ? p[at + n - 1] : T(0), p[at]);
      add_difference(k, p + at, p + at + 1, of_axis + at + 1, n - 1);
    }
  });
}

}  // namespace

at::Tensor divergence_by_loops(const FlowBox& box, const at::Tensor& u, double factor) {
  auto sizes = u.sizes().vec();
  sizes[1] = 1;
  const auto given = u.contiguous(), out = at::empty(sizes, u.options());
  AT_DISPATCH_FLOATING_TYPES(u.scalar_type(), "divergence_by_loops", [&] {
    const auto* values = given.const_data_ptr<scalar_t>();
    auto* result = out.mutable_data_ptr<scalar_t>();
    const int64_t cells = GridRows(box).cells();
    for_each_sample(u, [&](int64_t s) { divergence(box, values + s * box.dim() * cells, factor, result + s * cells); });
  });
  return out;
}

at::Tensor add_gradient_by_loops(const FlowBox& box, const at::Tensor& u, const at::Tensor& p, double factor,
                                 const at::Tensor& free) {
  const auto given = p.contiguous();
  auto out = free.defined() ? at::zeros(u.sizes(), u.options()) : u.clone(at::MemoryFormat::Contiguous);
  AT_DISPATCH_FLOATING_TYPES(u.scalar_type(), "add_gradient_by_loops", [&] {
    const auto* values = given.const_data_ptr<scalar_t>();
    auto* result = out.mutable_data_ptr<scalar_t>();
    const int64_t cells = GridRows(box).cells();
    for_each_sample(u,
                    [&](int64_t s) { add_gradient(box, values + s * cells, factor, result + s * box.dim() * cells); });
  });
  return free.defined() ? out.mul_(free).add_(u) : out;
}

}  // namespace prdp
