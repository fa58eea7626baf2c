#pragma once
#include "prdp/gpu/device/product_rules.h"

/// ∂⟨λ, A u⟩ for the winds and for ν of upwind differences on periodic grids, as in upwind.h: α I + β (Γ - ν L).
namespace prdp::gpu {

/// One or two axes, 0 along x and 1 along y.
template <class T>
struct PeriodicGrid {
  int n[2];
  T per_dx[2];

  int moved(int point, int axis, int cells) const {
    const int x = point % n[0], y = point / n[0];
    const int along = axis == 0 ? x : y, next = (along + cells + n[axis]) % n[axis];
    return axis == 0 ? y * n[0] + next : next * n[0] + x;
  }
};

/// The derivatives of max(w, 0) and of min(w, 0).
template <class T>
T slope_of_positive(T w) {
  return T(0.5) * (T(1) + T(w > 0) - T(w < 0));
}
template <class T>
T slope_of_negative(T w) {
  return T(0.5) * (T(1) - T(w > 0) + T(w < 0));
}

/// Of the winds of Burgers, (batch or 1, axes, *shape), whose means at the faces carry every channel.
template <class T>
struct BurgersProductRule {
  PairOfVectors<T> pair;
  PeriodicGrid<T> grid;
  T beta;
  int axes;
  const T* winds;
  T* out;

  void operator()(int i) const {
    const int point = i % pair.points, axis = i / pair.points % axes, s = i / (pair.points * axes);
    out[i] = T(0.5) * (of_face(s, axis, point) + of_face(s, axis, grid.moved(point, axis, -1)));
  }

 private:
  /// Of the wind at the face between a point and the next one.
  T of_face(int s, int axis, int before) const {
    const T* const mine = winds + (static_cast<int64_t>(s) * axes + axis) * pair.points;
    const int after = grid.moved(before, axis, 1);
    const T wind = T(0.5) * (mine[before] + mine[after]);
    const T above = slope_of_negative(wind), below = slope_of_positive(wind);
    return beta * grid.per_dx[axis] * pair.sum(s, [&](T& sum, const T* l, const T* v) {
      sum += (above * l[before] + below * l[after]) * (v[after] - v[before]);
    });
  }
};

/// Of the winds of Navier-Stokes, (batch or 1, 2 or 3, *shape), at the points of u₁ and u₂; a pressure blows nowhere.
template <class T>
struct NavierStokesProductRule {
  PairOfVectors<T> pair;  // of three channels
  PeriodicGrid<T> grid;
  int channels;
  const T* winds;
  T* out;

  void operator()(int i) const {
    const int point = i % pair.points, channel = i / pair.points % channels, s = i / (pair.points * channels);
    if (channel == 2) {
      out[i] = 0;
      return;
    }
    // The other component was carried by the mean of this one over four points.
    const int axis = channel, other = 1 - channel;
    const int back = grid.moved(point, axis, -1);
    const T carried = of_wind(s, other, axis, point) + of_wind(s, other, axis, back) +
                      of_wind(s, other, axis, grid.moved(point, other, 1)) +
                      of_wind(s, other, axis, grid.moved(back, other, 1));
    out[i] = of_wind(s, channel, axis, point) + T(0.25) * carried;
  }

 private:
  /// Of the wind along an axis at a point of u₁ or u₂.
  T of_wind(int s, int component, int axis, int here) const {
    const T* const mine = winds + (static_cast<int64_t>(s) * channels + axis) * pair.points;
    T wind = mine[here];
    if (axis != component) {
      const int beside = grid.moved(here, axis, 1);
      wind = T(0.25) *
             (wind + mine[beside] + mine[grid.moved(here, component, -1)] + mine[grid.moved(beside, component, -1)]);
    }
    const int before = grid.moved(here, axis, -1), after = grid.moved(here, axis, 1);
    const T below = slope_of_positive(wind), above = slope_of_negative(wind);
    T sum = 0;
    for (int k = 0; k < pair.samples; ++k) {
      const int64_t begin = ((static_cast<int64_t>(s) * pair.samples + k) * pair.channels + component) * pair.points;
      const T *l = pair.lambda + begin, *v = pair.u + begin;
      sum += l[here] * (below * (v[here] - v[before]) + above * (v[after] - v[here]));
    }
    return grid.per_dx[axis] * sum;
  }
};

/// Of ν, a number for each sample: -β Σ λ L u over its first channels.
template <class T>
struct ViscosityProductRule {
  PairOfVectors<T> pair;
  PeriodicGrid<T> grid;
  T beta;
  int axes, channels;
  double* out;  // (batch,)

  template <class Team>
  void operator()(int s, Team& team) const {
    double sum = 0;
    team.each(
        channels * pair.points, [&](int i) { return at(s, i / pair.points, i % pair.points); },
        [&](int, double value) { sum += value; });
    sum = team.sum(sum);
    if (team.leads()) out[s] = sum;
  }

 private:
  double at(int s, int channel, int here) const {
    const int64_t begin = (static_cast<int64_t>(s) * pair.channels + channel) * pair.points;
    const T* const v = pair.u + begin;
    T laplacian = 0;
    for (int axis = 0; axis < axes; ++axis)
      laplacian += grid.per_dx[axis] * grid.per_dx[axis] *
                   ((v[grid.moved(here, axis, -1)] - v[here]) + (v[grid.moved(here, axis, 1)] - v[here]));
    return -static_cast<double>(beta * pair.lambda[begin + here] * laplacian);
  }
};

}  // namespace prdp::gpu
