#pragma once
#include "prdp/gpu/device/flow_grid.h"
#include "prdp/solvers/status.h"

/// The explicit part of a step of a flow.
namespace prdp::gpu {

/// The largest Courant number of an explicit advection, for a ν.
struct CourantLimit {
  double free_per_nu = 0, taken_per_nu = 0;

  double at(double nu) const {
    const double free = std::sqrt(nu * free_per_nu), left = (free > 1.0 ? free : 1.0) - nu * taken_per_nu;
    return left > 0.0 ? left : 0.0;
  }
};

/// u with its boundary values and ghosts, and what is wrong with a sample: 0, or why it cannot be advected; then all
/// is zero.
template <class T>
struct FlowStart {
  FlowBoundaryValues<T> boundary;
  FlowField<const T> force;
  FlowNumber<T> nu;
  double dt;
  CourantLimit limit;
  FlowField<T> padded;
  int64_t* status;

  template <class Team>
  void operator()(int s, Team& team) const {
    const auto& grid = boundary.grid;
    const T courant = largest_of(team, grid.cells(), [&](int i) { return courant_at(s, grid.place(i)); });
    const T given = largest_of(team, grid.cells(), [&](int i) { return given_at(s, grid.place(i)); });
    const bool slow = std::isfinite(courant) && courant <= static_cast<T>(limit.at(static_cast<double>(nu.value(s))));
    const auto verdict = !std::isfinite(given) ? SolveStatus::kNonfiniteInput
                         : slow                ? SolveStatus{}
                                               : SolveStatus::kDiverged;
    if (team.leads()) status[s] = static_cast<int64_t>(verdict);
    const bool fine = verdict == SolveStatus{};
    for (int c = 0; c < grid.dim; ++c)
      team.each(
          grid.padded_cells(), [&](int i) { return fine ? boundary.value(s, c, grid.padded_place(i)) : T(0); },
          [&](int i, T value) { padded.of[c][s * padded.sample + i] = value; });
  }

 private:
  /// dt Σ_axes |u| / dx
  T courant_at(int s, const FlowPlace& p) const {
    const auto& grid = boundary.grid;
    T sum = 0;
    for (int a = grid.first_axis(); a < 3; ++a)
      sum += static_cast<T>(dt / grid.dx[a]) * std::abs(boundary.inside(s, 2 - a, p));
    return sum;
  }
  /// Not finite where u, the force or a wall is not. The sum above may also overflow where all are finite.
  T given_at(int s, const FlowPlace& p) const {
    T sum = 0;
    for (int c = 0; c < boundary.grid.dim; ++c) {
      sum += T(0) * boundary.inside(s, c, p);
      if (force) sum += T(0) * force.at(s, c, p);
      for (const auto& wall : boundary.walls)
        if (wall) sum += T(0) * wall.at(s, c, p);
    }
    return sum;
  }
};

/// What the terms of the momentum equation read.
template <class T>
struct FlowTerms {
  FlowGrid grid;
  const T* padded;  // (batch, dim, padded cells)
  FlowNumber<T> nu;
  bool upwind;
  double dt;
  FlowField<const T> free, friction;

  /// The advection of channel c along an axis, at a cell.
  kernels::AdvectionPoint<T> point(int s, int c, int axis, const FlowPlace& p) const {
    const int at = grid.padded(p), field = grid.padded_cells(), own = 2 - c;
    const T* const of_sample = padded + static_cast<int64_t>(s) * grid.dim * field + at;
    const T *of_c = of_sample + c * field, *of_w = of_sample + (2 - axis) * field;
    const int step = grid.padded_step(axis), own_step = grid.padded_step(own);
    return axis == own ? kernels::advection_point<true>(of_c, of_w, own_step, step)
                       : kernels::advection_point<false>(of_c, of_w, own_step, step);
  }
  T quarter_dx(int axis) const { return static_cast<T>(0.25 / grid.dx[axis]); }
  T diffusion(int s, int axis) const {
    return static_cast<T>(static_cast<double>(nu.value(s)) / (grid.dx[axis] * grid.dx[axis]));
  }
};

/// dt (-(u·∇)u + ν Δu + f) on the free faces, zero on all others.
template <class T>
struct FlowChange {
  FlowTerms<T> terms;
  FlowField<const T> force;
  const int64_t* status;
  FlowField<T> change;

  void operator()(int i) const {
    const auto& grid = terms.grid;
    const int cells = grid.cells(), field = i / cells, s = field / grid.dim, c = field % grid.dim;
    const auto p = grid.place(i % cells);
    T sum = 0;
    for (int a = grid.first_axis(); a < 3; ++a) {
      const auto read = terms.point(s, c, a, p);
      sum += terms.upwind ? kernels::advected<true>(read, terms.diffusion(s, a), terms.quarter_dx(a))
                          : kernels::advected<false>(read, terms.diffusion(s, a), terms.quarter_dx(a));
    }
    if (terms.friction)
      sum -= terms.nu.value(s) * terms.friction.at(s, c, p) *
             terms.padded[(static_cast<int64_t>(s) * grid.dim + c) * grid.padded_cells() + grid.padded(p)];
    if (force) sum += force.at(s, c, p);
    if (terms.free) sum *= terms.free.at(s, c, p);
    change.at(s, c, p) = status[s] == 0 ? sum * static_cast<T>(terms.dt) : T(0);
  }
};

/// The coefficients of I - ν dt Δ for each of the patterns -Δ, (patterns, samples, entries, cells): the point itself
/// first.
template <class T>
struct FlowDiffusionEntries {
  const T* patterns[3];
  int64_t sample;  // entries of a pattern between two samples; 0: they share it
  FlowNumber<T> nu;
  double dt;
  int samples, entries, cells;
  T* out;

  void operator()(int i) const {
    const int of_sample = entries * cells, at = i % of_sample, s = i / of_sample % samples;
    const T scaled = patterns[i / of_sample / samples][s * sample + at] * (nu.value(s) * static_cast<T>(dt));
    out[i] = at < cells ? scaled + T(1) : scaled;
  }
};

/// The reports of the solves of a step as one: the sum of their work, the worst status, the largest residual. A sample
/// that was refused has its own status.
template <class T>
struct FlowReport {
  static constexpr int kMost = 8;
  int solves;
  const int64_t *iterations[kMost], *statuses[kMost], *applications[kMost];
  const T *residuals[kMost], *floors[kMost];
  const int64_t* refused;  // null: none was
  int64_t *iterations_out, *status_out, *applications_out;
  T *residual_out, *floor_out;

  void operator()(int s) const {
    int64_t work = 0, products = 0, worst = statuses[0][s];
    T residual = residuals[0][s], floor = floors[0][s];
    bool solved = true;
    for (int k = 0; k < solves; ++k) {
      work += iterations[k][s];
      products += applications[k][s];
      worst = statuses[k][s] < worst ? statuses[k][s] : worst;
      residual = larger_or_nan(residual, residuals[k][s]);
      floor = larger_or_nan(floor, floors[k][s]);
      solved = solved && (statuses[k][s] > 0 || floors[k][s] > T(0));
    }
    const bool is_refused = refused && refused[s] != 0;
    iterations_out[s] = work;
    applications_out[s] = products;
    status_out[s] = is_refused ? refused[s] : worst;
    residual_out[s] = is_refused ? std::numeric_limits<T>::infinity() : residual;
    floor_out[s] = solved || solves == 1 ? floor : T(0);
  }
};

}  // namespace prdp::gpu
