#include "prdp/steppers/flow/explicit_loops.h"

#include <cmath>

namespace prdp {

namespace {

/// A field with ghosts in memory: axes z, y, x; in 2D there is one plane without ghosts.
struct PaddedGrid {
  int64_t n[3], stride[3], field;
  int64_t first;  // of the cells

  explicit PaddedGrid(const FlowBox& box) : n{1, 1, 1}, first(0) {
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
  /// f(place of the row's first cell in a padded field, and in one without ghosts).
  template <class F>
  void for_each_row(const F& f) const {
    for (int64_t z = 0; z < n[0]; ++z)
      for (int64_t y = 0; y < n[1]; ++y) f(first + z * stride[0] + y * stride[1], (z * n[1] + y) * n[2]);
  }
};

/// The derivative of component c along an axis b, whose own velocity is w: neighbours are `sb` apart along b, and `sa`
/// along c's own axis.
template <class T>
struct Term {
  bool own;  // w is c
  int64_t sa, sb;
  T half_dx, diffusion;  // 1/(2 dx), ν/dx²

  /// Twice the velocities through the low and the high edge.
  T low(const T* c, const T* w, int64_t i) const { return own ? c[i - sb] + c[i] : w[i - sa] + w[i]; }
  T high(const T* c, const T* w, int64_t i) const { return own ? c[i] + c[i + sb] : w[i + sb - sa] + w[i + sb]; }
};

/// out += the term, of a row.
template <class T>
void add_row(const Term<T>& t, FlowAdvection kind, const T* c, const T* w, T* out, int64_t n) {
  const T q = t.half_dx / 2;
  for (int64_t i = 0; i < n; ++i) {
    const T low = t.low(c, w, i), high = t.high(c, w, i);
    const T before = c[i - t.sb], here = c[i], after = c[i + t.sb];
    const T carried = kind == FlowAdvection::kCentral
                          ? high * after - low * before
                          : (low + std::abs(low)) * (here - before) + (high - std::abs(high)) * (after - here);
    out[i] += t.diffusion * (before - 2 * here + after) - q * carried;
  }
}

template <class T>
void add_shifted(const T* from, T* to, int64_t n) {
  for (int64_t i = 0; i < n; ++i) to[i] += from[i];
}

/// The same back: adds the cotangents of a row of c and w. `work`: five rows.
template <class T>
T add_row_back(const Term<T>& t, FlowAdvection kind, const T* c, const T* w, const T* g, T* c_bar, T* w_bar, T* work,
               int64_t n) {
  T *before_bar = work, *here_bar = work + n, *after_bar = work + 2 * n, *low_bar = work + 3 * n,
    *high_bar = work + 4 * n;
  const T q = t.half_dx / 2;
  T laplacian = 0;
  for (int64_t i = 0; i < n; ++i) {
    const T low = t.low(c, w, i), high = t.high(c, w, i), k = -q * g[i], spread = t.diffusion * g[i];
    const T before = c[i - t.sb], here = c[i], after = c[i + t.sb];
    laplacian += g[i] * (before - 2 * here + after);
    if (kind == FlowAdvection::kCentral) {
      before_bar[i] = spread - k * low;
      here_bar[i] = -2 * spread;
      after_bar[i] = spread + k * high;
      low_bar[i] = -k * before;
      high_bar[i] = k * after;
    } else {
      const T from_low = k * (low + std::abs(low)), from_high = k * (high - std::abs(high));
      before_bar[i] = spread - from_low;
      here_bar[i] = -2 * spread + from_low - from_high;
      after_bar[i] = spread + from_high;
      // The derivative of |v| at 0 is 0.
      low_bar[i] = k * (here - before) * (T(1) + T(low > 0) - T(low < 0));
      high_bar[i] = k * (after - here) * (T(1) - T(high > 0) + T(high < 0));
    }
  }
  add_shifted(before_bar, c_bar - t.sb, n);
  add_shifted(here_bar, c_bar, n);
  add_shifted(after_bar, c_bar + t.sb, n);
  T* const edge = t.own ? c_bar : w_bar;
  add_shifted(low_bar, t.own ? edge - t.sb : edge - t.sa, n);
  add_shifted(low_bar, edge, n);
  add_shifted(high_bar, t.own ? edge : edge + t.sb - t.sa, n);
  add_shifted(high_bar, edge + t.sb, n);
  return laplacian;
}

/// f(component's channel, channel of the velocity along the axis, the term) for all terms.
template <class T, class F>
void for_each_term(const FlowEquation& e, const PaddedGrid& grid, T nu, const F& f) {
  const auto& box = *e.box;
  const int64_t d = box.dim();
  for (int64_t along = 0; along < d; ++along)
    for (int64_t axis = 0; axis < d; ++axis) {
      const double dx = box.dx(axis);
      f(box.channel_of(along), box.channel_of(axis),
        Term<T>{axis == along, grid.stride[3 - d + along], grid.stride[3 - d + axis], static_cast<T>(0.5 / dx),
                static_cast<T>(nu / (dx * dx))},
        T(1) / static_cast<T>(dx * dx));
    }
}

at::Tensor without_ghosts(const FlowBox& box, const at::Tensor& padded) {
  auto sizes = padded.sizes().vec();
  for (int64_t axis = 0; axis < box.dim(); ++axis) sizes[axis + 2] = box.shape()[axis];
  return at::zeros(sizes, padded.options());
}

template <class T>
void run(const FlowEquation& e, const at::Tensor& padded, const at::Tensor& out) {
  const PaddedGrid grid(*e.box);
  const int64_t d = e.box->dim(), cells = out.numel() / std::max<int64_t>(1, out.size(0) * d);
  for (int64_t s = 0; s < out.size(0); ++s) {
    const T* p = padded.const_data_ptr<T>() + s * d * grid.field;
    T* o = out.mutable_data_ptr<T>() + s * d * cells;
    for_each_term<T>(e, grid, e.nu.item<T>(), [&](int64_t c, int64_t w, const Term<T>& term, T) {
      grid.for_each_row([&](int64_t at, int64_t to) {
        add_row(term, e.advection, p + c * grid.field + at, p + w * grid.field + at, o + c * cells + to, grid.n[2]);
      });
    });
  }
}

template <class T>
double run_back(const FlowEquation& e, const at::Tensor& padded, const at::Tensor& g, const at::Tensor& bar) {
  const PaddedGrid grid(*e.box);
  const int64_t d = e.box->dim(), cells = g.numel() / std::max<int64_t>(1, g.size(0) * d);
  std::vector<T> work(5 * grid.n[2]);
  double nu_bar = 0;
  for (int64_t s = 0; s < g.size(0); ++s) {
    const T* p = padded.const_data_ptr<T>() + s * d * grid.field;
    T* b = bar.mutable_data_ptr<T>() + s * d * grid.field;
    const T* given = g.const_data_ptr<T>() + s * d * cells;
    for_each_term<T>(e, grid, e.nu.item<T>(), [&](int64_t c, int64_t w, const Term<T>& term, T per_nu) {
      double sum = 0;
      grid.for_each_row([&](int64_t at, int64_t from) {
        sum += static_cast<double>(add_row_back(term, e.advection, p + c * grid.field + at, p + w * grid.field + at,
                                                given + c * cells + from, b + c * grid.field + at,
                                                b + w * grid.field + at, work.data(), grid.n[2]));
      });
      nu_bar += sum * static_cast<double>(per_nu);
    });
  }
  return nu_bar;
}

}  // namespace

at::Tensor advect_and_diffuse(const FlowEquation& equation, const at::Tensor& padded) {
  const auto out = without_ghosts(*equation.box, padded);
  padded.scalar_type() == at::kFloat ? run<float>(equation, padded, out) : run<double>(equation, padded, out);
  return out;
}

ExplicitVjp advect_and_diffuse_vjp(const FlowEquation& equation, const at::Tensor& padded,
                                   const at::Tensor& cotangent) {
  const auto g = cotangent.contiguous(), bar = at::zeros_like(padded);
  const double nu = padded.scalar_type() == at::kFloat ? run_back<float>(equation, padded, g, bar)
                                                       : run_back<double>(equation, padded, g, bar);
  return {bar, at::full({}, nu, padded.options())};
}

}  // namespace prdp
