#include "prdp/operators/upwind_rule_loops.h"

#include <ATen/Dispatch.h>

#include <algorithm>

#include "prdp/gpu/device/upwind_product_rule.h"
#include "prdp/operators/sets_of_samples.h"

namespace prdp {

namespace {

/// The grid of one field, (ny, nx), of which ny may be 1. Axis 0 is x, 1 is y.
template <class T>
struct Plane {
  int64_t ny, nx;
  T per_dx[2], per_dx2[2], laplacian_diagonal;

  explicit Plane(const Grid& grid)
      : ny(grid.dim() == 2 ? grid.shape()[0] : 1),
        nx(grid.shape().back()),
        laplacian_diagonal(static_cast<T>(prdp::laplacian_diagonal(grid))) {
    for (int64_t d = 0; d < grid.dim(); ++d) {
      per_dx[grid.dim() - 1 - d] = static_cast<T>(1.0 / grid.dx(d));
      per_dx2[grid.dim() - 1 - d] = static_cast<T>(1.0 / (grid.dx(d) * grid.dx(d)));
    }
  }
  int64_t points() const { return ny * nx; }

  /// f(before, here, after) for the places of each point and of its neighbours along an axis.
  template <class F>
  void each(int axis, const F& f) const {
    for (int64_t j = 0; j < ny; ++j) {
      const int64_t here = j * nx;
      if (axis == 0) {
        f(here + nx - 1, here, here + 1);
        for (int64_t i = here + 1; i < here + nx - 1; ++i) f(i - 1, i, i + 1);
        f(here + nx - 2, here + nx - 1, here);
      } else {
        const int64_t before = (j > 0 ? j - 1 : ny - 1) * nx, after = (j + 1 < ny ? j + 1 : 0) * nx;
        for (int64_t i = 0; i < nx; ++i) f(before + i, here + i, after + i);
      }
    }
  }
};

template <class T>
void mean_with_next(const Plane<T>& plane, int axis, const T* __restrict v, T* __restrict mean) {
  plane.each(axis, [=](int64_t, int64_t i, int64_t next) { mean[i] = (v[i] + v[next]) * T(0.5); });
}
template <class T>
void mean_with_previous(const Plane<T>& plane, int axis, const T* __restrict v, T* __restrict mean) {
  plane.each(axis, [=](int64_t before, int64_t i, int64_t) { mean[i] = (v[before] + v[i]) * T(0.5); });
}

/// β λ times the backward and the forward difference of u, added to what is there.
template <class T>
void add_differences(const Plane<T>& plane, int axis, T beta, const T* __restrict l, const T* __restrict v,
                     T* __restrict backward, T* __restrict forward) {
  plane.each(axis, [=, per_dx = plane.per_dx[axis]](int64_t before, int64_t i, int64_t after) {
    backward[i] += beta * l[i] * ((v[i] - v[before]) * per_dx);
    forward[i] += beta * l[i] * ((v[after] - v[i]) * per_dx);
  });
}

/// -β λ L u of one field.
template <class T>
void laplacian_terms(const Plane<T>& plane, T beta, const T* __restrict l, const T* __restrict v, T* __restrict out) {
  for (int64_t i = 0; i < plane.points(); ++i) out[i] = plane.laplacian_diagonal * v[i];
  for (int axis = plane.ny > 1 ? 1 : 0; axis >= 0; --axis)
    plane.each(axis, [=, per_dx2 = plane.per_dx2[axis]](int64_t before, int64_t i, int64_t after) {
      out[i] += (v[before] + v[after]) * per_dx2;
    });
  for (int64_t i = 0; i < plane.points(); ++i) out[i] *= -beta * l[i];
}

/// Samples that share their winds, (samples, channels, points) behind each other.
template <class T>
struct Fields {
  int64_t samples, channels;
  const T *lambda, *u;
};

/// Of Burgers' wind along an axis. `memory` holds three fields.
template <class T>
void burgers_wind(const Plane<T>& plane, int axis, T beta, const Fields<T>& fields, const T* __restrict wind,
                  T* __restrict memory, T* __restrict out) {
  const int64_t points = plane.points();
  T* __restrict const face = memory, * __restrict const lower = face + points, * __restrict const upper = lower + points;
  mean_with_next(plane, axis, wind, face);
  std::fill_n(lower, 2 * points, T(0));
  for (int64_t k = 0; k < fields.samples * fields.channels; ++k)
    add_differences(plane, axis, beta, fields.lambda + k * points, fields.u + k * points, lower, upper);
  plane.each(axis, [=](int64_t before, int64_t i, int64_t) {
    lower[i] *= gpu::slope_of_positive(face[before]);
    upper[i] *= gpu::slope_of_negative(face[i]);
  });
  plane.each(axis, [=](int64_t before, int64_t i, int64_t after) {
    out[i] = (lower[i] + lower[after]) * T(0.5) + (upper[before] + upper[i]) * T(0.5);
  });
}

/// Of the winds of Navier-Stokes, a component each: its own, and what the mean of it over four points carried.
/// `memory` holds four fields.
template <class T>
void navier_stokes_winds(const Plane<T>& plane, const Fields<T>& fields, const T* winds, T* __restrict memory, T* out) {
  const int64_t points = plane.points();
  T *const lower = memory, *const upper = lower + points, *const some = upper + points, *const mean = some + points;
  // ∂/∂(the wind along an axis) at the points of a component, into lower.
  const auto of_wind = [&](int component, int axis, const T* __restrict w) {
    std::fill_n(lower, 2 * points, T(0));
    for (int64_t k = component; k < fields.samples * fields.channels; k += fields.channels)
      add_differences(plane, axis, T(1), fields.lambda + k * points, fields.u + k * points, lower, upper);
    for (int64_t i = 0; i < points; ++i)
      lower[i] = gpu::slope_of_positive(w[i]) * lower[i] + gpu::slope_of_negative(w[i]) * upper[i];
  };
  // A mean of four, at the points of a component from those of the other one; each is the transpose of the other.
  const auto mean_at = [&](int component, const T* from) {
    (component == 0 ? mean_with_previous<T> : mean_with_next<T>)(plane, /*axis=*/0, from, some);
    (component == 0 ? mean_with_next<T> : mean_with_previous<T>)(plane, /*axis=*/1, some, mean);
  };
  for (const int axis : {0, 1}) {
    T* const bar = out + axis * points;
    const T* const wind = winds + axis * points;
    of_wind(axis, axis, wind);
    std::copy_n(lower, points, bar);
    mean_at(1 - axis, wind);
    of_wind(1 - axis, axis, mean);
    mean_at(axis, lower);
    for (int64_t i = 0; i < points; ++i) bar[i] += mean[i];
  }
}

/// `of_set(plane, fields, winds, memory, out)` finds the derivative of the winds that samples share. ν acts on
/// `channels`, whose terms are summed `at_once`.
template <class T, class OfSet>
UpwindGradients products(const Grid& grid, const at::Tensor& winds, T beta, int64_t channels, int64_t at_once,
                         const at::Tensor& lambda, const at::Tensor& u, const OfSet& of_set) {
  const auto w = winds.detach().contiguous(), l = lambda.contiguous(), v = u.contiguous();
  const Plane<T> plane(grid);
  const int64_t batch = l.size(0), points = plane.points(), stride = l.size(1) * points, blowing = w.size(1) * points;
  const SetsOfSamples sets(batch, w.size(0));
  auto shape = w.sizes().vec();
  shape[0] = sets.count;
  const auto out = at::zeros(shape, w.options());  // a pressure blows nowhere
  const auto terms = at::empty({channels / at_once, batch, at_once, points}, w.options());
  sets.share(stride, [&](int64_t set, int64_t first, int64_t samples) {
    std::vector<T> memory(4 * points);
    const Fields<T> fields{samples, l.size(1), l.const_data_ptr<T>() + first * stride,
                           v.const_data_ptr<T>() + first * stride};
    of_set(plane, fields, w.const_data_ptr<T>() + (w.size(0) == 1 ? 0 : set) * blowing, memory.data(),
           out.mutable_data_ptr<T>() + set * blowing);
    for (int64_t s = 0; s < samples; ++s)
      for (int64_t c = 0; c < channels; ++c)
        laplacian_terms(
            plane, beta, fields.lambda + s * stride + c * points, fields.u + s * stride + c * points,
            terms.mutable_data_ptr<T>() + ((c / at_once * batch + first + s) * at_once + c % at_once) * points);
  });
  return {sets.count > w.size(0) ? out.sum(0, /*keepdim=*/true) : out, terms.unbind()};
}

}  // namespace

std::optional<UpwindGradients> burgers_rule_on_loops(const Grid& grid, const at::Tensor& winds, double beta,
                                                     const at::Tensor& lambda, const at::Tensor& u) {
  if (!has_product_rule_loops(lambda, u, winds)) return std::nullopt;
  return AT_DISPATCH_FLOATING_TYPES(u.scalar_type(), "burgers_rule_on_loops", [&] {
    using T = scalar_t;
    const int64_t channels = u.size(1);
    return products<T>(grid, winds, static_cast<T>(beta), channels, /*at_once=*/channels, lambda, u,
                       [&](const auto& plane, const auto& fields, const T* mine, T* memory, T* out) {
                         for (int axis = 0; axis < grid.dim(); ++axis)
                           burgers_wind(plane, axis, static_cast<T>(beta), fields, mine + axis * plane.points(), memory,
                                        out + axis * plane.points());
                       });
  });
}

std::optional<UpwindGradients> navier_stokes_rule_on_loops(const Grid& grid, const at::Tensor& winds,
                                                           const at::Tensor& lambda, const at::Tensor& u) {
  if (!has_product_rule_loops(lambda, u, winds)) return std::nullopt;
  return AT_DISPATCH_FLOATING_TYPES(u.scalar_type(), "navier_stokes_rule_on_loops", [&] {
    return products<scalar_t>(grid, winds, scalar_t(1), /*channels=*/2, /*at_once=*/1, lambda, u,
                              navier_stokes_winds<scalar_t>);
  });
}

}  // namespace prdp
