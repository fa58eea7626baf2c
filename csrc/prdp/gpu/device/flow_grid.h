#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/gpu/device/largest.h"
#include "prdp/kernels/flow_points.h"

/// The staggered grid of a flow, its fields and its boundary, as kernels know them. Sizes are arguments: a kernel
/// serves every grid.
namespace prdp::gpu {

/// What is at the ends of an axis, as prdp::FlowBoundary counts.
inline constexpr int kPeriodicEnds = 0, kWallEnds = 1, kOpenEnds = 2, kSlipEnds = 3;

/// Indices along z, y and x, from 0 on; -1 and n are ghosts.
struct FlowPlace {
  int at[3];
  FlowPlace moved(int axis, int cells) const {
    FlowPlace other = *this;
    other.at[axis] += cells;
    return other;
  }
};

/// Axes are z, y and x; in 2D there is one plane, without ghosts. Channel 2 - a is the velocity along axis a.
struct FlowGrid {
  int dim, n[3], ends[3];
  double dx[3];

  int first_axis() const { return 3 - dim; }
  int cells() const { return n[0] * n[1] * n[2]; }
  FlowPlace place(int cell) const { return {{cell / (n[2] * n[1]), cell / n[2] % n[1], cell % n[2]}}; }
  bool has(const FlowPlace& p) const {
    bool inside = true;
    for (int a = 0; a < 3; ++a) inside = inside && p.at[a] >= 0 && p.at[a] < n[a];
    return inside;
  }
  /// The place at the other end of a periodic axis.
  FlowPlace wrapped(FlowPlace p) const {
    for (int a = 0; a < 3; ++a)
      if (ends[a] == kPeriodicEnds) p.at[a] += p.at[a] < 0 ? n[a] : p.at[a] >= n[a] ? -n[a] : 0;
    return p;
  }

  // Of a field with ghosts.
  int width(int axis) const { return axis < first_axis() ? 1 : n[axis] + 2; }
  int padded_cells() const { return width(0) * width(1) * width(2); }
  int padded_step(int axis) const { return axis == 2 ? 1 : axis == 1 ? width(2) : width(1) * width(2); }
  FlowPlace padded_place(int i) const {
    FlowPlace p{{i / (width(2) * width(1)), i / width(2) % width(1), i % width(2)}};
    for (int a = first_axis(); a < 3; ++a) --p.at[a];
    return p;
  }
  int padded(const FlowPlace& p) const {
    int i = 0;
    for (int a = first_axis(); a < 3; ++a) i += (p.at[a] + 1) * padded_step(a);
    return i;
  }

  /// By what the value of channel c at the first or last cell of an axis becomes that of the ghost beyond it. A
  /// velocity is zero on a wall, half a cell away, or has no gradient where it slips, and that through the high wall
  /// lies on it.
  template <class T>
  T ghost_factor(int axis, bool high, int c) const {
    const bool is_wall = ends[axis] == kWallEnds, slips = ends[axis] == kSlipEnds;
    if ((is_wall || slips) && high && c == 2 - axis) return T(0);
    return is_wall || (ends[axis] == kOpenEnds && !high) ? T(-1) : T(1);
  }
};

/// A field of some channels, which may have gaps; the steps are 0 along what all share.
template <class T>
struct FlowField {
  T* of[3];  // the channels; null where there is no such field
  int64_t sample;
  int step[3];

  explicit operator bool() const { return of[0] != nullptr; }
  T& at(int s, int c, const FlowPlace& p) const {
    return of[c][s * sample + p.at[0] * step[0] + p.at[1] * step[1] + p.at[2] * step[2]];
  }
};

/// A number of the device for all samples, or one for each; of the host, where the first is null.
template <class T>
struct FlowNumber {
  const T* of_device;
  int64_t sample;  // the step from one to the next: 0, if all share it
  T of_host;
  T value(int s) const { return of_device ? of_device[s * sample] : of_host; }
};

/// A velocity, and what the boundary makes of it.
template <class T>
struct FlowBoundaryValues {
  FlowGrid grid;
  FlowField<const T> u, free, inlet, inflow;
  FlowField<const T> walls[6];  // the velocity of the low and the high wall of each axis

  T inside(int s, int c, const FlowPlace& p) const {
    T value = u.at(s, c, p);
    if (free) value *= free.at(s, c, p);
    if (inlet) value += inlet.at(s, c, p) * inflow.at(s, c, p);
    return value;
  }
  /// At a ghost, too. The open axis gets its ghosts first, then the others in turn: each takes those before it along.
  T value(int s, int c, FlowPlace p) const {
    T factor = 1, added = 0;
    for (int a = 2; a >= grid.first_axis(); --a)
      if (grid.ends[a] != kOpenEnds) reflect(s, c, a, p, factor, added);
    for (int a = 2; a >= grid.first_axis(); --a)
      if (grid.ends[a] == kOpenEnds) reflect(s, c, a, p, factor, added);
    return factor * inside(s, c, p) + added;
  }

 private:
  void reflect(int s, int c, int axis, FlowPlace& p, T& factor, T& added) const {
    const bool low = p.at[axis] < 0, high = p.at[axis] >= grid.n[axis];
    if (!low && !high) return;
    if (grid.ends[axis] == kPeriodicEnds) {
      p = grid.wrapped(p);
      return;
    }
    p.at[axis] = low ? 0 : grid.n[axis] - 1;
    const auto& wall = walls[2 * axis + high];
    // Walls move along themselves; in the corners, nothing reads what they add.
    if (wall && grid.has(p)) added += factor * (2 * wall.at(s, c, p));
    if (low && grid.ends[axis] == kOpenEnds) added += factor * (2 * inflow.at(s, c, p));
    factor *= grid.ghost_factor<T>(axis, high, c);
  }
};

}  // namespace prdp::gpu
