#include "prdp/steppers/flow/explicit_loops.h"

#include <ATen/core/grad_mode.h>

#include <array>
#include <cmath>
#include <numeric>
#include <vector>

#include "prdp/kernels/loops.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/each_sample.h"

namespace prdp {

namespace {

using kernels::AdvectionTerm;

/// A field with ghosts in memory: axes z, y, x; in 2D there is one plane without ghosts.
struct GhostedGrid {
  int64_t n[3], stride[3], field;
  int64_t first;  // of the cells

  explicit GhostedGrid(const FlowBox& box) : n{1, 1, 1}, first(0) {
    int64_t size = 1;
    for (int64_t a = 2; a >= 0; --a) {
      const int64_t axis = a - (3 - box.dim());
      stride[a] = size;
      if (axis < 0) continue;
      n[a] = box.shape()[axis];
      size *= n[a] + 2;
      first += stride[a];
    }
    field = size;
  }
  int64_t cells() const { return n[0] * n[1] * n[2]; }
  /// f(place of the row's first cell in a padded field, and in one without ghosts).
  template <class F>
  void for_each_row(const F& f) const {
    for (int64_t z = 0; z < n[0]; ++z)
      for (int64_t y = 0; y < n[1]; ++y) f(first + z * stride[0] + y * stride[1], (z * n[1] + y) * n[2]);
  }
};

/// f(component's channel, channel of the velocity along the axis, the term, 1/dx²) for all terms.
template <class T, class F>
void for_each_term(const FlowEquation& e, const GhostedGrid& grid, double nu, const F& f) {
  const auto& box = *e.box;
  const int64_t d = box.dim();
  for (int64_t along = 0; along < d; ++along)
    for (int64_t axis = 0; axis < d; ++axis) {
      const double dx = box.dx(axis);
      f(box.channel_of(along), box.channel_of(axis),
        AdvectionTerm<T>{axis == along, e.advection == FlowAdvection::kUpwind, grid.stride[3 - d + along],
                         grid.stride[3 - d + axis], static_cast<T>(0.25 / dx), static_cast<T>(nu / (dx * dx))},
        1.0 / (dx * dx));
    }
}

/// The rows of `bars` as advect_row_back() fills them, a value for each point of a row of the grid.
enum Bars { kBefore, kHere, kAfter, kLow, kHigh, kDiffusion, kBars };

/// Adds the cotangents of a row of c and w from those of what its points read.
template <class T>
void add_row_back(const AdvectionTerm<T>& t, const T* bars, T* c_bar, T* w_bar, int64_t n) {
  const auto add = [&](Bars k, T* to) { kernels::loops<T>().axpy(T(1), bars + k * n, to, n); };
  add(kBefore, c_bar - t.step);
  add(kHere, c_bar);
  add(kAfter, c_bar + t.step);
  T* const edge = t.own ? c_bar : w_bar;
  add(kLow, t.own ? edge - t.step : edge - t.own_step);
  add(kLow, edge);
  add(kHigh, t.own ? edge : edge + t.step - t.own_step);
  add(kHigh, edge + t.step);
}

template <class T>
void advect(const FlowEquation& e, const at::Tensor& padded, const at::Tensor& out) {
  const GhostedGrid grid(*e.box);
  const int64_t d = e.box->dim(), cells = grid.cells();
  const auto nu = to_host<double>(e.nu, padded.size(0));
  const T* given = padded.const_data_ptr<T>();
  T* result = out.mutable_data_ptr<T>();
  for_each_sample(out, [&](int64_t s) {
    const T* p = given + s * d * grid.field;
    T* o = result + s * d * cells;
    for_each_term<T>(e, grid, nu[s], [&](int64_t c, int64_t w, const AdvectionTerm<T>& term, double) {
      grid.for_each_row([&](int64_t at, int64_t to) {
        kernels::loops<T>().advect_row(term, p + c * grid.field + at, p + w * grid.field + at, o + c * cells + to,
                                       grid.n[2]);
      });
    });
  });
}

/// Returns the cotangent of ν by each sample.
template <class T>
std::vector<double> advect_back(const FlowEquation& e, const at::Tensor& padded, const at::Tensor& g,
                                const at::Tensor& bar) {
  const GhostedGrid grid(*e.box);
  const int64_t d = e.box->dim(), cells = grid.cells(), n = grid.n[2];
  const auto nu = to_host<double>(e.nu, padded.size(0));
  const T *values = padded.const_data_ptr<T>(), *cotangents = g.const_data_ptr<T>();
  T* result = bar.mutable_data_ptr<T>();
  std::vector<double> nu_bars(g.size(0));
  for_each_sample(g, [&](int64_t s) {
    const T *p = values + s * d * grid.field, *given = cotangents + s * d * cells;
    T* b = result + s * d * grid.field;
    std::vector<T> bars(kBars * n);
    for_each_term<T>(e, grid, nu[s], [&](int64_t c, int64_t w, const AdvectionTerm<T>& term, double per_nu) {
      std::fill_n(bars.data() + kDiffusion * n, n, T(0));
      grid.for_each_row([&](int64_t at, int64_t from) {
        kernels::loops<T>().advect_row_back(term, p + c * grid.field + at, p + w * grid.field + at,
                                            given + c * cells + from, bars.data(), n);
        add_row_back(term, bars.data(), b + c * grid.field + at, b + w * grid.field + at, n);
      });
      double sum = 0;
      for (int64_t i = 0; i < n; ++i) sum += static_cast<double>(bars[kDiffusion * n + i]);
      nu_bars[s] += sum * per_nu;
    });
  });
  return nu_bars;
}

/// max of dt Σ |u|/dx over the cells, in blocks that stay in the cache. NaN or Inf ends the search.
template <class T>
T largest_courant_number(const FlowEquation& e, const T* u, int64_t cells) {
  constexpr int64_t block = 1024;
  std::array<T, block> sums;
  T largest = 0;
  for (int64_t begin = 0; begin < cells; begin += block) {
    const int64_t n = std::min(block, cells - begin);
    std::fill_n(sums.data(), n, T(0));
    for (int64_t axis = 0; axis < e.box->dim(); ++axis) {
      const T k = static_cast<T>(e.dt / e.box->dx(axis));
      const T* of_axis = u + e.box->channel_of(axis) * cells + begin;
      for (int64_t i = 0; i < n; ++i) sums[i] += k * std::abs(of_axis[i]);
    }
    const T here = kernels::loops<T>().largest_magnitude(sums.data(), n);
    if (!(here <= largest)) largest = here;  // NaN too
    if (!std::isfinite(largest)) break;
  }
  return largest;
}

}  // namespace

bool flow_has_loops(const at::Tensor& u) { return u.is_cpu() && is_plain(u) && !at::GradMode::is_enabled(); }

at::Tensor advect_and_diffuse(const FlowEquation& equation, const at::Tensor& padded) {
  auto sizes = padded.sizes().vec();
  for (int64_t axis = 0; axis < equation.box->dim(); ++axis) sizes[axis + 2] = equation.box->shape()[axis];
  const auto out = at::zeros(sizes, padded.options());
  padded.scalar_type() == at::kFloat ? advect<float>(equation, padded, out) : advect<double>(equation, padded, out);
  return out;
}

ExplicitVjp advect_and_diffuse_vjp(const FlowEquation& equation, const at::Tensor& padded,
                                   const at::Tensor& cotangent) {
  const auto g = cotangent.contiguous(), bar = at::zeros_like(padded);
  const auto of_samples = padded.scalar_type() == at::kFloat ? advect_back<float>(equation, padded, g, bar)
                                                             : advect_back<double>(equation, padded, g, bar);
  if (equation.nu.numel() > 1) return {bar, at::tensor(of_samples, padded.options()).view_as(equation.nu)};
  const double sum = std::accumulate(of_samples.begin(), of_samples.end(), 0.0);
  return {bar, at::full_like(equation.nu, sum)};
}

at::Tensor courant_numbers_by_loops(const FlowEquation& equation, const at::Tensor& u) {
  const auto given = u.contiguous(), out = at::empty({u.size(0)}, u.options());
  AT_DISPATCH_FLOATING_TYPES(u.scalar_type(), "courant_numbers", [&] {
    const auto* values = given.const_data_ptr<scalar_t>();
    auto* found = out.mutable_data_ptr<scalar_t>();
    const int64_t cells = GhostedGrid(*equation.box).cells(), d = equation.box->dim();
    for_each_sample(u, [&](int64_t s) { found[s] = largest_courant_number(equation, values + s * d * cells, cells); });
  });
  return out;
}

}  // namespace prdp
