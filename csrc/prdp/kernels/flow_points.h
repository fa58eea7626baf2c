#pragma once
/// Advection and diffusion of a flow at one point: the text that the CPU's loops and the kernels of a GPU share.
namespace prdp::kernels {

namespace {  // each instruction set has its own

template <class T>
T magnitude(T x) {
  return x < 0 ? -x : x;
}

/// What a point reads of a component c of a velocity along an axis, and of the component w along that axis: c at the
/// point and at its neighbours, and twice the velocities through its low and its high edge.
template <class T>
struct AdvectionPoint {
  T low, high, before, here, after;
};
/// At c[0] and w[0]; neighbours lie `step` apart along the axis, and `own_step` along the axis of c. Own: w is c.
template <bool Own, class T, class Step>
AdvectionPoint<T> advection_point(const T* c, const T* w, Step own_step, Step step) {
  return {Own ? c[-step] + c[0] : w[-own_step] + w[0], Own ? c[0] + c[step] : w[step - own_step] + w[step], c[-step],
          c[0], c[step]};
}

/// ν ∂²c - (w ∂)c, with ν/dx² and 1/(4 dx).
template <bool Upwind, class T>
T advected(const AdvectionPoint<T>& p, T diffusion, T quarter_dx) {
  const T carried =
      Upwind ? (p.low + magnitude(p.low)) * (p.here - p.before) + (p.high - magnitude(p.high)) * (p.after - p.here)
             : p.high * p.after - p.low * p.before;
  return diffusion * (p.before - 2 * p.here + p.after) - quarter_dx * carried;
}

/// The cotangents of what a point reads, and of ν/dx², from that of the result.
template <class T>
struct AdvectionBars {
  T before, here, after, low, high, diffusion;
};
template <bool Upwind, class T>
AdvectionBars<T> advected_back(const AdvectionPoint<T>& p, T diffusion, T quarter_dx, T g) {
  const T k = -quarter_dx * g, spread = diffusion * g;
  const T from_low = k * (Upwind ? p.low + magnitude(p.low) : p.low);
  const T from_high = k * (Upwind ? p.high - magnitude(p.high) : p.high);
  // The derivative of |v| at 0 is 0.
  return {spread - from_low,
          -2 * spread + (Upwind ? from_low - from_high : T(0)),
          spread + from_high,
          Upwind ? k * (p.here - p.before) * (T(1) + T(p.low > 0) - T(p.low < 0)) : -k * p.before,
          Upwind ? k * (p.after - p.here) * (T(1) - T(p.high > 0) + T(p.high < 0)) : k * p.after,
          g * (p.before - 2 * p.here + p.after)};
}

/// k (after - here), of which a divergence and a gradient are made.
template <class T>
T difference(T k, T here, T after) {
  return k * (after - here);
}

}  // namespace

}  // namespace prdp::kernels
