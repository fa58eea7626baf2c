#include "prdp/steppers/flow/box.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "prdp/error_text.h"
#include "prdp/grid/grid.h"
#include "prdp/solvers/kept_hierarchy.h"
#include "prdp/steppers/flow/boundaries.h"

namespace prdp {

namespace {

constexpr int64_t kFewest = 3;  // cells of an axis: a cell, and a neighbour on each side

template <class T>
std::vector<T> per_axis(const std::vector<T>& given, size_t axes, const char* what) {
  TORCH_CHECK_VALUE(given.size() == 1 || given.size() == axes, "Flow: ", what,
                    " must be one for all axes or one per axis, ", axes, " here, got ", given.size());
  return given.size() == 1 ? std::vector<T>(axes, given[0]) : given;
}

/// If the whole pressure of the explicit part is taken off, waves beside walls grow from ν dt/dx² = 10 to 16 on, in
/// thin boxes and on long, thin cells. Measured as the spectral radius of steps of Stokes flow.
constexpr double kLargestWhole = 4;

/// Around an island with a throat one cell wide a flow grows too: the pressure passes the drag of the throat on to all
/// the fluid that moves as one. This begins at ν dt Σ 1/dx² = 1.5, summed over the axes across the throat; the longer
/// the way around, the sooner.
constexpr double kLargestWholeOfThroats = 1.25;

/// Nothing holds the flow: diffusion and projection commute.
constexpr double kUnlimited = std::numeric_limits<float>::max();

void set_largest_diffusion(const FlowBox& box, FlowFields& fields) {
  // Across the throat are all axes but one, at worst the one with the largest dx.
  const double dx = box.largest_dx(), across = box.sum_of_couplings() / 2 - 1 / (dx * dx);
  double least = box.dx(0);
  for (int64_t axis = 1; axis < box.dim(); ++axis) least = std::min(least, box.dx(axis));
  const auto& obstacle = box.obstacle();
  const double whole = kLargestWhole * least * least, of_throats = kLargestWholeOfThroats / across;
  fields.largest_diffusion = obstacle.defined() ? of_throats : whole;
  if (!obstacle.defined()) return;
  const auto number = [](double x) { return at::full({}, x, at::kDouble); };
  const auto has_obstacle = obstacle.flatten(1).any(1);
  if (has_obstacle.all().item<bool>()) return;
  auto& found = fields.largest_diffusions = at::where(has_obstacle, number(of_throats), number(whole));
  if (fields.is_free.defined()) found = at::where(fields.is_free, number(kUnlimited), found);
}

}  // namespace

FlowBoundary flow_boundary_from_name(const std::string& name) {
  if (name == "periodic") return FlowBoundary::kPeriodic;
  if (name == "wall") return FlowBoundary::kWall;
  if (name == "slip") return FlowBoundary::kSlip;
  TORCH_CHECK_VALUE(name == "open", "Flow: boundary must be 'periodic', 'wall', 'slip' or 'open', got '", name, "'");
  return FlowBoundary::kOpen;
}

FlowBox::FlowBox(std::vector<int64_t> shape, const std::vector<FlowBoundary>& boundary,
                 const std::vector<double>& length, at::Tensor obstacle)
    : shape_(std::move(shape)), obstacle_(std::move(obstacle)) {
  TORCH_CHECK_VALUE(shape_.size() == 2 || shape_.size() == 3,
                    "Flow: shape must have 2 or 3 extents, (Ny, Nx) or (Nz, Ny, Nx), got ", at::IntArrayRef(shape_));
  for (const int64_t n : shape_)
    TORCH_CHECK_VALUE(n >= kFewest, "Flow: every extent of shape must be >= ", kFewest, ", got ",
                      at::IntArrayRef(shape_));
  boundary_ = per_axis(boundary, shape_.size(), "boundary");
  length_ = per_axis(length, shape_.size(), "length");
  for (const double side : length_)
    TORCH_CHECK_VALUE(std::isfinite(side) && side > 0, "Flow: length must be finite and > 0, got ", side);
  TORCH_CHECK_VALUE(std::count(boundary_.begin(), boundary_.end(), FlowBoundary::kOpen) <= 1,
                    "Flow: at most one axis may be open");
  const c10::InferenceMode may_be_recorded_later(false);
  if (obstacle_.defined()) {
    check_obstacle(obstacle_, shape_);
    obstacle_ = obstacle_.detach().to(at::kCPU, /*non_blocking=*/false, /*copy=*/true).contiguous();
    if (obstacle_.dim() == dim()) obstacle_ = obstacle_.unsqueeze(0);
    samples_ = obstacle_.size(0);
    if (!obstacle_.any().item<bool>()) obstacle_ = at::Tensor();
  }
  fields_ = make_flow_fields(*this);
  set_largest_diffusion(*this, fields_);
}

int64_t FlowBox::open_axis() const {
  const auto found = std::find(boundary_.begin(), boundary_.end(), FlowBoundary::kOpen);
  return found == boundary_.end() ? -1 : found - boundary_.begin();
}

bool FlowBox::is_held() const {
  const auto holds = [](FlowBoundary b) { return b == FlowBoundary::kWall || b == FlowBoundary::kOpen; };
  const auto is_closed = [](FlowBoundary b) { return b != FlowBoundary::kPeriodic; };
  const bool all_have_obstacles = obstacle_.defined() && obstacle_.flatten(1).any(1).all().item<bool>();
  return all_have_obstacles || std::any_of(boundary_.begin(), boundary_.end(), holds) ||
         std::all_of(boundary_.begin(), boundary_.end(), is_closed);
}

double FlowBox::largest_dx() const {
  double largest = dx(0);
  for (int64_t axis = 1; axis < dim(); ++axis) largest = std::max(largest, dx(axis));
  return largest;
}

double FlowBox::sum_of_couplings() const {
  double sum = 0;
  for (int64_t axis = 0; axis < dim(); ++axis) sum += 2.0 / (dx(axis) * dx(axis));
  return sum;
}

void FlowBox::check_velocity(const at::Tensor& u) const {
  bool fits = u.dim() == dim() + 2 && u.size(1) == dim();
  for (int64_t axis = 0; fits && axis < dim(); ++axis) fits = u.size(axis + 2) == shape_[axis];
  if (!fits) {
    std::ostringstream expected;
    for (const int64_t n : shape_) expected << ", " << n;
    TORCH_CHECK_VALUE(false, "Flow: expected u of shape (batch, ", dim(), expected.str(), "), got ", u.sizes());
  }
  TORCH_CHECK_VALUE(samples_ == 1 || samples_ == u.size(0), "Flow: obstacle holds ", samples_, " samples, u holds ",
                    u.size(0));
  TORCH_CHECK_TYPE(u.scalar_type() == at::kFloat || u.scalar_type() == at::kDouble,
                   "Flow: u must be float32 or float64, got ", dtype_name(u.scalar_type()),
                   hint_of_dtype(u.scalar_type()));
}

const FlowFields& FlowBox::fields(const at::TensorOptions& options) const {
  const auto dtype = c10::typeMetaToScalarType(options.dtype());
  const std::lock_guard lock(mutex_);
  const auto [entry, is_new] = converted_.try_emplace({dtype, options.device().str()});
  if (!is_new) return entry->second;
  auto& found = entry->second = fields_;
  const at::NoGradGuard no_grad;
  const c10::InferenceMode may_be_recorded_later(false);
  for (auto* t : {&found.cells, &found.free, &found.inlet, &found.friction, &found.pressure, &found.closed_parts})
    if (t->defined()) *t = t->to(options.device(), dtype);
  if (const auto& parts = found.closed_parts; parts.defined())
    found.null_vectors = parts.size(0) > 1 ? parts.unsqueeze(2) : parts.squeeze(0);
  for (auto* t : {&found.is_free, &found.largest_diffusions, &found.part_of_cell})
    if (t->defined()) *t = t->to(options.device());
  for (auto* list : {&found.diffusion, &found.high_sign})
    for (auto& t : *list) t = t.to(options.device(), dtype);
  found.coarse_grids = std::make_shared<gpu::KeptHierarchy>(/*most=*/std::numeric_limits<int64_t>::max());
  return found;
}

at::Tensor neighbour(const FlowBox& box, const at::Tensor& t, int64_t axis, int64_t cells, double outside) {
  const int64_t d = t.dim() - box.dim() + axis, n = t.size(d);
  if (box.boundary(axis) == FlowBoundary::kPeriodic) return at::roll(t, -cells, d);
  const auto end = at::full_like(t.narrow(d, 0, 1), outside);
  return cells > 0 ? at::cat({t.narrow(d, 1, n - 1), end}, d) : at::cat({end, t.narrow(d, 0, n - 1)}, d);
}

}  // namespace prdp
