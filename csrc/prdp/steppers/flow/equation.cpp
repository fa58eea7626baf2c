#include "prdp/steppers/flow/equation.h"

#include <ATen/ExpandUtils.h>
#include <ATen/TracerMode.h>

#include <algorithm>
#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/kernels.h"

namespace prdp {

namespace {

/// Raises ValueError or TypeError unless t is (d,) or (batch or 1, *of_sample).
void check_field(const char* name, const at::Tensor& t, std::vector<int64_t> of_sample) {
  const int64_t d = of_sample[0];
  TORCH_CHECK_TYPE(at::isFloatingType(t.scalar_type()), "Flow: ", name, " must hold real numbers, got ",
                   dtype_name(t.scalar_type()));
  const bool uniform = t.dim() == 1 && t.size(0) == d;
  const bool field =
      t.dim() == static_cast<int64_t>(of_sample.size()) + 1 && t.sizes().slice(1) == at::IntArrayRef(of_sample);
  std::ostringstream expected;
  for (const int64_t n : of_sample) expected << ", " << n;
  TORCH_CHECK_VALUE(uniform || field, "Flow: ", name, " must have shape (", d, ",) or (batch or 1", expected.str(),
                    "), got ", t.sizes());
}

std::vector<int64_t> shape_of_force(const FlowBox& box) {
  auto shape = box.shape();
  shape.insert(shape.begin(), box.dim());
  return shape;
}

std::vector<int64_t> shape_of_inflow(const FlowBox& box) {
  auto shape = shape_of_force(box);
  shape[1 + box.open_axis()] = 1;
  return shape;
}

std::vector<int64_t> shape_of_wall(const FlowBox& box, int64_t axis) {
  auto shape = shape_of_force(box);
  shape.erase(shape.begin() + 1 + axis);
  return shape;
}

/// Raises ValueError or TypeError unless it is the velocity of a wall at an end of an axis, along the wall.
void check_wall(const FlowBox& box, size_t i, const at::Tensor& velocity) {
  const auto name = name_of_wall(i);
  const auto axis = static_cast<int64_t>(i) / 2;
  TORCH_CHECK_VALUE(box.boundary(axis) == FlowBoundary::kWall, "Flow: ", name, " is on an axis whose boundary is not ",
                    in_language("'wall'", "FlowBoundary::kWall"));
  check_field(name.c_str(), velocity, shape_of_wall(box, axis));
  const auto through = velocity.detach().select(velocity.dim() == 1 ? 0 : 1, box.channel_of(axis));
  TORCH_CHECK_VALUE(!through.any().item<bool>(), "Flow: ", name, " must be along the wall: its component ",
                    box.channel_of(axis), " must be 0");
}

/// A tensor of one axis with all axes of a state, its own at `place`: (d,) → (1, d, 1, …).
at::Tensor with_all_axes(at::Tensor t, const at::Tensor& u, int64_t place = 1) {
  if (!t.defined()) return t;
  if (t.dim() == 1) {
    std::vector<int64_t> sizes(u.dim(), 1);
    sizes[place] = t.size(0);
    t = t.reshape(sizes);
  }
  return t.to(u.options());
}

/// Returns the largest nu. Raises ValueError for one that is out of range, TypeError for one that is complex.
double check_nu(const FlowEquation& e) {
  TORCH_CHECK_TYPE(!e.nu.is_complex(), "Flow: nu must be real, got ", dtype_name(e.nu.scalar_type()));
  TORCH_CHECK_VALUE(e.nu.dim() <= 1, "Flow: nu must be a number, or a tensor of shape () or (batch or 1,), got ",
                    e.nu.sizes());
  const auto values = e.nu_values();
  double largest = 0;
  for (size_t i = 0; i < values.size(); ++i) {
    TORCH_CHECK_VALUE(std::isfinite(values[i]) && values[i] >= 0, "Flow: nu must be finite and >= 0, got ", values[i],
                      e.nu.dim() == 0 ? "" : c10::str(" at index ", i));
    largest = std::max(largest, values[i]);
  }
  return largest;
}

}  // namespace

FlowAdvection flow_advection_from_name(const std::string& name) {
  if (name == "central") return FlowAdvection::kCentral;
  TORCH_CHECK_VALUE(name == "upwind", "Flow: advection must be 'central' or 'upwind', got '", name, "'");
  return FlowAdvection::kUpwind;
}

FlowDiffusion flow_diffusion_from_name(const std::string& name) {
  if (name == "implicit") return FlowDiffusion::kImplicit;
  TORCH_CHECK_VALUE(name == "explicit", "Flow: diffusion must be 'implicit' or 'explicit', got '", name, "'");
  return FlowDiffusion::kExplicit;
}

FlowPressure flow_pressure_from_name(const std::string& name) {
  if (name == "incremental") return FlowPressure::kIncremental;
  TORCH_CHECK_VALUE(name == "plain", "Flow: pressure must be 'incremental' or 'plain', got '", name, "'");
  return FlowPressure::kPlain;
}

std::string name_of_wall(size_t i) {
  const char* const end = i % 2 ? in_language("'high'", "FlowEnd::kHigh") : in_language("'low'", "FlowEnd::kLow");
  return c10::str("wall_velocity of side (", i / 2, ", ", end, ")");
}

double FlowEquation::check() const {
  TORCH_CHECK_VALUE(box && nu.defined(), "Flow: an equation needs a box and nu; one that was moved from has none");
  for (const auto& t : tensors())
    TORCH_CHECK_VALUE(!t.defined() || !t.is_meta(), "Flow: a tensor of it is on meta, where it has no values: give it ",
                      "some, as with to_empty and load_state_dict");
  TORCH_CHECK_VALUE(std::isfinite(dt) && dt > 0, "Flow: dt must be finite and > 0, got ", dt);
  const double number = check_nu(*this) * dt * box->sum_of_couplings();
  TORCH_CHECK_VALUE(is_diffused_implicitly() || number <= 1 + 1e-6,
                    "Flow: explicit diffusion needs nu dt Σ 2/dx² <= 1, got ", number, "; take a smaller dt or ",
                    in_language("diffusion='implicit'", "FlowDiffusion::kImplicit"));
  if (force.defined()) check_field("force", force, shape_of_force(*box));
  TORCH_CHECK_VALUE(inflow.defined() == (box->open_axis() >= 0),
                    inflow.defined() ? "Flow: inflow is for an open axis, and boundary has none"
                                     : "Flow: an open axis needs inflow, the velocity at its low end");
  if (inflow.defined()) check_field("inflow", inflow, shape_of_inflow(*box));
  for (size_t i = 0; i < wall_velocity.size(); ++i)
    if (wall_velocity[i].defined()) check_wall(*box, i, wall_velocity[i]);
  return number;
}

double FlowEquation::check(const at::Tensor& u) const {
  TORCH_CHECK_TYPE(!at::tracer::impl::is_dispatch_enabled(),
                   "Flow: torch.jit.trace cannot record it; take torch.compile");
  auto all = tensors();
  all.push_back(u);
  TORCH_CHECK_NOT_IMPLEMENTED(!in_torch_func() || !at::areAnyTensorSubclassLike(all),
                              "Flow: takes no transform of torch.func; use autograd.grad and batches");
  TORCH_CHECK_NOT_IMPLEMENTED(!any_tangent(all), "Flow: takes no dual tensors of forward mode; use autograd.grad");
  const double number = check();
  box->check_velocity(u);
  const auto check_samples = [&](const std::string& name, int64_t samples) {
    TORCH_CHECK_VALUE(samples == 1 || samples == u.size(0), "Flow: ", name, " holds ", samples, " samples, u holds ",
                      u.size(0));
  };
  const auto check_batch = [&](const std::string& name, const at::Tensor& t) {
    if (t.defined() && t.dim() > 1) check_samples(name, t.size(0));
  };
  if (nu.dim() == 1) check_samples("nu", nu.size(0));
  check_batch("force", force);
  check_batch("inflow", inflow);
  for (size_t i = 0; i < wall_velocity.size(); ++i) check_batch(name_of_wall(i), wall_velocity[i]);
  return number;
}

void FlowEquation::check_steps(const at::Tensor& u, int64_t steps) const {
  const double number = check(u);
  constexpr double most = 1e6;  // beyond, 1 is rounding beside the coefficients of I - nu dt Δ
  const bool is_unaffected = steps == 0 || !is_diffused_implicitly() || u.scalar_type() == at::kDouble;
  TORCH_CHECK_VALUE(
      number <= most || is_unaffected || box->is_held(),
      "Flow: float32 loses the mean velocity of a periodic box, or along walls with slip, where nu dt Σ 2/dx² > ", most,
      ", got ", number, "; take float64 or a smaller dt");
}

FlowEquation FlowEquation::for_state(const at::Tensor& u) const {
  auto all = tensors();
  // Kernels take a number of the host as it is: a copy would make the host wait.
  const bool stays = nu.is_cpu() && nu.dim() == 0 && flow_kernels::can_run(u);
  all[kNu] = stays ? nu.to(u.scalar_type()) : with_all_axes(nu, u, /*place=*/0);
  for (size_t i = kForce; i < all.size(); ++i) {
    if (i >= kFirstWall && all[i].defined() && all[i].dim() > 1)
      all[i] = all[i].unsqueeze(2 + static_cast<int64_t>(i - kFirstWall) / 2);
    all[i] = with_all_axes(all[i], u);
  }
  return with_tensors(all);
}

std::vector<double> FlowEquation::nu_values() const { return to_host<double>(nu, nu.numel()); }

double FlowEquation::largest_nu() const {
  double largest = 0;
  for (const double value : nu_values()) largest = std::max(largest, value);
  return largest;
}

at::Tensor FlowEquation::nu_gradient(const at::Tensor& terms) const {
  return nu.dim() == 0 ? total(terms) : at::sum_to(sample_totals(terms), nu.sizes());
}

std::vector<at::Tensor> FlowEquation::tensors() const {
  std::vector<at::Tensor> all{nu, force, inflow};
  all.insert(all.end(), wall_velocity.begin(), wall_velocity.end());
  return all;
}

at::Tensor FlowEquation::velocity_of_wall(int64_t axis, bool high) const {
  return wall_velocity.empty() ? at::Tensor() : wall_velocity[2 * axis + high];
}

FlowEquation FlowEquation::with_tensors(at::TensorList tensors) const {
  auto other = *this;
  other.nu = tensors[kNu];
  other.force = tensors[kForce];
  other.inflow = tensors[kInflow];
  other.wall_velocity = tensors.slice(kFirstWall).vec();
  return other;
}

}  // namespace prdp
