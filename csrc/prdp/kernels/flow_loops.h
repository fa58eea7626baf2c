#pragma once
#include "prdp/kernels/flow_points.h"
#include "prdp/kernels/loops.h"

/// The part of loops.cpp for the advection and diffusion of a flow; included there only.
namespace prdp::kernels {

namespace {

template <bool Own, bool Upwind, class T>
void add_advection(const AdvectionTerm<T>& t, const T* c, const T* w, T* __restrict__ out, int64_t n) {
  for (int64_t i = 0; i < n; ++i)
    out[i] += advected<Upwind>(advection_point<Own>(c + i, w + i, t.own_step, t.step), t.diffusion, t.quarter_dx);
}

template <bool Own, bool Upwind, class T>
void advection_back(const AdvectionTerm<T>& t, const T* c, const T* w, const T* g, T* __restrict__ bars, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const auto p = advection_point<Own>(c + i, w + i, t.own_step, t.step);
    const auto of = advected_back<Upwind>(p, t.diffusion, t.quarter_dx, g[i]);
    bars[i] = of.before;
    bars[n + i] = of.here;
    bars[2 * n + i] = of.after;
    bars[3 * n + i] = of.low;
    bars[4 * n + i] = of.high;
    bars[5 * n + i] += of.diffusion;
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
