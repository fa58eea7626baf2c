#pragma once
#include "prdp/kernels/loops.h"

/// The part of loops.cpp for the advection and diffusion of a flow; included there only.
namespace prdp::kernels {

namespace {

template <class T>
T magnitude(T x) {
  return x < 0 ? -x : x;
}

/// Twice the velocities through the low and the high edge of a cell.
template <bool Own, class T>
struct Edges {
  T low, high;
  Edges(const AdvectionTerm<T>& t, const T* c, const T* w, int64_t i)
      : low(Own ? c[i - t.step] + c[i] : w[i - t.own_step] + w[i]),
        high(Own ? c[i] + c[i + t.step] : w[i + t.step - t.own_step] + w[i + t.step]) {}
};

template <bool Own, bool Upwind, class T>
void add_advection(const AdvectionTerm<T>& t, const T* c, const T* w, T* __restrict__ out, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const Edges<Own, T> v(t, c, w, i);
    const T before = c[i - t.step], here = c[i], after = c[i + t.step];
    const T carried = Upwind
                          ? (v.low + magnitude(v.low)) * (here - before) + (v.high - magnitude(v.high)) * (after - here)
                          : v.high * after - v.low * before;
    out[i] += t.diffusion * (before - 2 * here + after) - t.quarter_dx * carried;
  }
}

template <bool Own, bool Upwind, class T>
void advection_back(const AdvectionTerm<T>& t, const T* c, const T* w, const T* g, T* __restrict__ bars, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const Edges<Own, T> v(t, c, w, i);
    const T before = c[i - t.step], here = c[i], after = c[i + t.step];
    const T k = -t.quarter_dx * g[i], spread = t.diffusion * g[i];
    const T from_low = k * (Upwind ? v.low + magnitude(v.low) : v.low);
    const T from_high = k * (Upwind ? v.high - magnitude(v.high) : v.high);
    bars[i] = spread - from_low;
    bars[n + i] = -2 * spread + (Upwind ? from_low - from_high : T(0));
    bars[2 * n + i] = spread + from_high;
    // The derivative of |v| at 0 is 0.
    bars[3 * n + i] = Upwind ? k * (here - before) * (T(1) + T(v.low > 0) - T(v.low < 0)) : -k * before;
    bars[4 * n + i] = Upwind ? k * (after - here) * (T(1) - T(v.high > 0) + T(v.high < 0)) : k * after;
    bars[5 * n + i] += g[i] * (before - 2 * here + after);
  }
}

template <class T>
void advect_row(const AdvectionTerm<T>& t, const T* c, const T* w, T* out, int64_t n) {
  const auto loop = t.own ? (t.upwind ? add_advection<true, true, T> : add_advection<true, false, T>)
                          : (t.upwind ? add_advection<false, true, T> : add_advection<false, false, T>);
  loop(t, c, w, out, n);
}

template <class T>
void advect_row_back(const AdvectionTerm<T>& t, const T* c, const T* w, const T* g, T* bars, int64_t n) {
  const auto loop = t.own ? (t.upwind ? advection_back<true, true, T> : advection_back<true, false, T>)
                          : (t.upwind ? advection_back<false, true, T> : advection_back<false, false, T>);
  loop(t, c, w, g, bars, n);
}

}  // namespace

}  // namespace prdp::kernels
