#include <algorithm>
#include <vector>

#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/sets_of_samples.h"

/// The product rule of a Diffusion by loops on the CPU. They round as the tensor operations do, but where samples share
/// κ.
namespace prdp {

namespace {

/// One axis of a field of cells: `lines` times n times `stride`.
template <class T>
struct AxisOfCells {
  int64_t lines, n, stride;
  T scale;  // 1/w² for cells as wide as w
  bool harmonic;
  int64_t cells() const { return lines * n * stride; }
};

/// λ and u, (fields, cells): of all channels of samples that share κ.
template <class T>
struct Fields {
  int64_t count;
  const T *lambda, *u;
};

/// What `count` cells, and others `apart` places away, get from the faces between them. `coupled` is memory for
/// `count`.
template <class T>
void add_through_faces(const AxisOfCells<T>& axis, int64_t first, int64_t apart, int64_t count, const Fields<T>& fields,
                       const T* __restrict kappa, T* __restrict coupled, T* __restrict out) {
  std::fill_n(coupled, count, T(0));
  for (int64_t k = 0; k < fields.count; ++k) {
    const T* __restrict const l = fields.lambda + k * axis.cells() + first, * __restrict const v =
                                                                                fields.u + k * axis.cells() + first;
    for (int64_t i = 0; i < count; ++i) coupled[i] += (v[i + apart] - v[i]) * (l[i + apart] - l[i]);
  }
  const T *const low = kappa + first, *const high = low + apart;
  T *const low_out = out + first, *const high_out = low_out + apart;
  const T scale = axis.scale;
  if (!axis.harmonic) {
    for (int64_t i = 0; i < count; ++i) high_out[i] += scale * coupled[i] * T(0.5);
    for (int64_t i = 0; i < count; ++i) low_out[i] += scale * coupled[i] * T(0.5);
    return;
  }
  // ∂/∂κ of a harmonic mean; 0 where κ is not finite: the sample was refused.
  const auto of_mean = [](T share) { return share == share ? T(2) * (share * share) : T(0); };
  for (int64_t i = 0; i < count; ++i) high_out[i] += scale * coupled[i] * of_mean(low[i] / (high[i] + low[i]));
  for (int64_t i = 0; i < count; ++i) low_out[i] += scale * coupled[i] * of_mean(high[i] / (low[i] + high[i]));
}

/// What the cells at one end get from u = 0 on their side.
template <class T>
void add_at_zero_side(const AxisOfCells<T>& axis, int64_t first, const Fields<T>& fields, T* out) {
  for (int64_t i = first; i < first + axis.stride; ++i) {
    T product = 0;
    for (int64_t k = 0; k < fields.count; ++k)
      product += fields.u[k * axis.cells() + i] * fields.lambda[k * axis.cells() + i];
    out[i] += T(2) * (axis.scale * product);
  }
}

}  // namespace

template <class T>
void DiffusionOperator::add_rule_of_axis(int64_t d, const at::Tensor& lambda, const at::Tensor& u,
                                         const at::Tensor& kappa_bar) const {
  const auto l = lambda.contiguous(), v = u.contiguous(), kappa = kappa_.detach().contiguous();
  const int64_t stride = c10::multiply_integers(at::IntArrayRef(shape_).slice(d + 1));
  const AxisOfCells<T> axis{c10::multiply_integers(at::IntArrayRef(shape_).slice(0, d)), shape_[d], stride,
                            static_cast<T>(inverse_width2(d)), box_.mean == FaceMean::kHarmonic};
  const int64_t cells = axis.cells(), kappas = kappa.size(1), which = per_axis_ ? d : 0, length = axis.n * stride;
  const int64_t size = l.size(1) * cells, own = kappa.size(0) == 1 ? 0 : kappas * cells;
  SetsOfSamples(l.size(0), kappa.size(0)).share(size, [&](int64_t set, int64_t sample, int64_t samples) {
    std::vector<T> memory(length);
    const Fields<T> fields{samples * l.size(1), l.const_data_ptr<T>() + sample * size,
                           v.const_data_ptr<T>() + sample * size};
    const T* const k = kappa.const_data_ptr<T>() + set * own + which * cells;
    T* const out = kappa_bar.mutable_data_ptr<T>() + set * cells;
    for (int64_t first = 0; first < cells; first += length) {
      const int64_t last = first + length - stride;
      add_through_faces(axis, first, stride, length - stride, fields, k, memory.data(), out);
      if (wraps_around(d)) add_through_faces(axis, last, first - last, stride, fields, k, memory.data(), out);
      if (box_.sides[d][0] == Side::kZero) add_at_zero_side(axis, first, fields, out);
      if (box_.sides[d][1] == Side::kZero) add_at_zero_side(axis, last, fields, out);
    }
  });
}

void DiffusionOperator::add_rule_on_loops(int64_t axis, const at::Tensor& lambda, const at::Tensor& u,
                                          at::Tensor& kappa_bar) const {
  if (!kappa_bar.defined()) {
    auto shape = lambda.sizes().vec();
    shape[0] = SetsOfSamples(lambda.size(0), kappa_.size(0)).count;
    shape[1] = 1;
    kappa_bar = at::zeros(shape, lambda.options());
  }
  const auto add = lambda.scalar_type() == at::kFloat ? &DiffusionOperator::add_rule_of_axis<float>
                                                      : &DiffusionOperator::add_rule_of_axis<double>;
  (this->*add)(axis, lambda, u, kappa_bar);
}

}  // namespace prdp
