#pragma once
#include <ATen/ATen.h>

#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

namespace prdp {

namespace gpu {
class KeptHierarchy;
}

/// What is at the two ends of an axis of a flow.
enum class FlowBoundary {
  kPeriodic,
  kWall,  // no slip at both ends
  kOpen,  // the inflow at the low end; pressure zero and no normal gradient at the high end
  kSlip,  // walls without friction at both ends: what is beyond them mirrors what is before
};
/// "periodic", "wall", "open" or "slip"; raises ValueError for other names.
FlowBoundary flow_boundary_from_name(const std::string& name);

/// What the equations of a flow know about the box, as tensors of one dtype and device, with one sample, or as many as
/// there are obstacles. Undefined masks are 1 everywhere.
struct FlowFields {
  at::Tensor cells;                   // (…, 1, *shape): where the pressure is unknown
  at::Tensor free;                    // (…, d, *shape): faces whose velocity is unknown
  at::Tensor inlet;                   // (…, d, *shape): faces that carry the inflow; undefined if there are none
  at::Tensor friction;                // (…, d, *shape): 1/dx² for each neighbour inside an obstacle; or undefined
  at::Tensor pressure;                // (…, 2 d + 1, *shape): coefficients of -dx² div grad
  std::vector<at::Tensor> diffusion;  // (…, 2 d + 1, *shape) for each component: -Δ; a single one if all are the same
  std::vector<double> low_sign;  // per axis: the ghost beyond its low wall is so many times the first
  std::vector<at::Tensor> high_sign;  // per axis, (d, 1, …): that beyond its high wall is so many times the last
  /// (…, parts, *shape): 1 in the cells of each closed part of the fluid, where the pressure has no level; zeros where
  /// a sample has fewer. Empty for one part of all cells, undefined if there are none.
  at::Tensor closed_parts;
  at::Tensor null_vectors;  // the same as a singular operator takes them
  at::Tensor part_of_cell;  // (…, cells): the closed part that a cell is in, from 1 on, or 0; undefined if none is
  at::Tensor is_free;  // (samples,) bool, where all faces of some of them are free, but not of all; else undefined
  /// The largest ν dt for which an incremental step takes the whole pressure of the explicit part off (balance.h): of
  /// all samples, or where they differ, of each, (samples,) in float64.
  double largest_diffusion = 0;
  at::Tensor largest_diffusions;
  std::shared_ptr<gpu::KeptHierarchy> coarse_grids;  // of the pressure, on a GPU
};

/// A box of cells with a staggered grid (Harlow and Welch 1965): pressures in the centres, and each component of the
/// velocity on the low face of its own axis. Axes are those of `shape`, (Ny, Nx) or (Nz, Ny, Nx); channel c of a
/// velocity (batch, d, *shape) is the component along axis d - 1 - c, so that channel 0 is the one along x. Immutable.
class FlowBox {
 public:
  /// `boundary` and `length`: one for all axes, or one per axis. `obstacle`: bool (*shape), or (batch or 1, *shape) for
  /// one of each sample, true in solid cells; undefined if there are none. Raises ValueError or TypeError for what does
  /// not fit together.
  FlowBox(std::vector<int64_t> shape, const std::vector<FlowBoundary>& boundary, const std::vector<double>& length,
          at::Tensor obstacle);

  int64_t dim() const { return static_cast<int64_t>(shape_.size()); }
  const std::vector<int64_t>& shape() const { return shape_; }
  FlowBoundary boundary(int64_t axis) const { return boundary_[axis]; }
  double dx(int64_t axis) const { return length_[axis] / static_cast<double>(shape_[axis]); }
  /// (samples, *shape); undefined if there are none.
  const at::Tensor& obstacle() const { return obstacle_; }
  /// How many samples have an obstacle of their own; 1: all are in the same box.
  int64_t samples() const { return samples_; }
  /// The axis with an inflow, or -1.
  int64_t open_axis() const;
  int64_t channel_of(int64_t axis) const { return dim() - 1 - axis; }
  /// Whether walls, obstacles or an inflow hold the mean velocity. Walls with slip hold that through them alone.
  bool is_held() const;
  double largest_dx() const;
  /// Σ_axes 2 / dx².
  double sum_of_couplings() const;

  /// Raises ValueError or TypeError unless u is (batch, d, *shape) in float32 or float64, and has a sample for each
  /// obstacle.
  void check_velocity(const at::Tensor& u) const;
  const FlowFields& fields(const at::TensorOptions& options) const;

 private:
  std::vector<int64_t> shape_;
  std::vector<FlowBoundary> boundary_;
  std::vector<double> length_;
  at::Tensor obstacle_;
  int64_t samples_ = 1;
  FlowFields fields_;  // float64, on the CPU
  mutable std::mutex mutex_;
  mutable std::map<std::pair<at::ScalarType, std::string>, FlowFields> converted_;
};

/// t at the neighbour that lies `cells` (1 or -1) further along an axis of the box; beyond an end that is not
/// periodic, `outside`. The axes of the box are the last ones of t.
at::Tensor neighbour(const FlowBox& box, const at::Tensor& t, int64_t axis, int64_t cells, double outside);

}  // namespace prdp
