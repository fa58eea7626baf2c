#include "prdp/steppers/flow/tendency.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>

#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/explicit_loops.h"

namespace prdp {

namespace {

/// Views of a component of a field with ghosts, the grid's size along all axes but those that say otherwise.
class Padded {
 public:
  Padded(const FlowBox& box, const at::Tensor& all) : box_(box), all_(all) {}
  /// Channel c, at the neighbour one cell to a `side`, -1 or 1, along an axis.
  at::Tensor at(int64_t c, int64_t axis, int64_t side) const {
    auto view = all_.select(1, c);
    for (int64_t a = 0; a < box_.dim(); ++a) view = view.narrow(a + 1, 1 + (a == axis ? side : 0), box_.shape()[a]);
    return view;
  }
  /// The N + 1 values along `axis` that begin at the ghost (0) or at the first cell (1); at the neighbour to that side
  /// along the axis `other`.
  at::Tensor edges(int64_t c, int64_t axis, int64_t begin, int64_t other = -1, int64_t side = 0) const {
    auto view = all_.select(1, c);
    for (int64_t a = 0; a < box_.dim(); ++a)
      view = a == axis ? view.narrow(a + 1, begin, box_.shape()[a] + 1)
                       : view.narrow(a + 1, 1 + (a == other ? side : 0), box_.shape()[a]);
    return view;
  }

 private:
  const FlowBox& box_;
  const at::Tensor& all_;
};

/// (u·∇) of the component along `along`: its derivative along `axis`, times the velocity along that axis.
at::Tensor advection(const FlowBox& box, const Padded& u, int64_t along, int64_t axis, FlowAdvection kind) {
  const int64_t c = box.channel_of(along), d = axis + 1, n = box.shape()[axis];
  const auto before = u.edges(c, axis, 0), after = u.edges(c, axis, 1);
  // The velocity through the edges between neighbours.
  const auto through =
      axis == along
          ? (before + after) * 0.5
          : (u.edges(box.channel_of(axis), axis, 1, along, -1) + u.edges(box.channel_of(axis), axis, 1)) * 0.5;
  const auto low = [&](const at::Tensor& t) { return t.narrow(d, 0, n); };
  const auto high = [&](const at::Tensor& t) { return t.narrow(d, 1, n); };
  if (kind == FlowAdvection::kCentral)
    return (high(through) * high(after) - low(through) * low(before)) * (0.5 / box.dx(axis));
  const auto jump = after - before, size = through.abs();
  return (low((through + size) * jump) + high((through - size) * jump)) * (0.5 / box.dx(axis));
}

at::Tensor laplacian(const FlowBox& box, const Padded& u, int64_t c) {
  at::Tensor sum = u.at(c, 0, 0) * -box.sum_of_couplings();
  for (int64_t axis = 0; axis < box.dim(); ++axis)
    sum = sum.add(u.at(c, axis, -1) + u.at(c, axis, 1), 1.0 / (box.dx(axis) * box.dx(axis)));
  return sum;
}

/// -(u·∇)u + ν Δu in tensor operations.
at::Tensor advect_and_diffuse_tensors(const FlowEquation& equation, const at::Tensor& ghosts) {
  const auto& box = *equation.box;
  const Padded padded(box, ghosts);
  const auto nu = equation.nu.dim() == 0 ? equation.nu : equation.nu.squeeze(1);  // beside one component
  std::vector<at::Tensor> components;
  for (int64_t c = 0; c < box.dim(); ++c) {
    auto sum = laplacian(box, padded, c) * nu;
    for (int64_t axis = 0; axis < box.dim(); ++axis)
      sum = sum - advection(box, padded, box.dim() - 1 - c, axis, equation.advection);
    components.push_back(sum);
  }
  return at::stack(components, 1);
}

/// The order in which the axes get their ghosts: the open one first, so that the others take its ghosts along.
std::vector<int64_t> axes_of_ghosts(const FlowBox& box) {
  std::vector<int64_t> axes;
  for (int64_t axis = 0; axis < box.dim(); ++axis)
    axes.insert(axis == box.open_axis() ? axes.begin() : axes.end(), axis);
  return axes;
}

/// The ghosts plus twice the velocity of the wall; zero is added in the corners, beyond the ends of the axes that have
/// their ghosts already. No difference reads the corners.
at::Tensor add_wall(const FlowEquation& equation, int64_t axis, bool high, const at::Tensor& ghosts) {
  const auto velocity = equation.velocity_of_wall(axis, high);
  if (!velocity.defined()) return ghosts;
  std::vector<int64_t> pads;
  for (int64_t a = ghosts.dim() - 1; a > 1; --a)
    pads.insert(pads.end(), 2, a == axis + 2 || velocity.size(a) == 1 ? 0 : (ghosts.size(a) - velocity.size(a)) / 2);
  return ghosts + 2 * at::constant_pad_nd(velocity, pads);
}

/// The cotangent of the velocity of the wall from that of the ghosts.
at::Tensor add_wall_back(const FlowEquation& equation, int64_t axis, bool high, at::Tensor ghosts) {
  const auto velocity = equation.velocity_of_wall(axis, high);
  if (!velocity.defined()) return velocity;
  for (int64_t a = 2; a < ghosts.dim(); ++a) {
    const int64_t n = a == axis + 2 ? 1 : equation.box->shape()[a - 2];
    ghosts = ghosts.narrow(a, (ghosts.size(a) - n) / 2, n);
  }
  return at::sum_to(2 * ghosts, velocity.sizes());
}

/// The cotangents of u, of the inflow and of the walls from that of the field with ghosts, which is overwritten.
void ghosts_back(const FlowEquation& equation, at::Tensor padded, TendencyVjp& found) {
  const auto& box = *equation.box;
  const auto& fields = box.fields(padded.options());
  auto axes = axes_of_ghosts(box);
  std::reverse(axes.begin(), axes.end());
  found.wall_velocity.resize(equation.wall_velocity.size());
  for (const int64_t axis : axes) {
    const int64_t d = axis + 2, n = box.shape()[axis];
    const auto low = padded.narrow(d, 0, 1), high = padded.narrow(d, n + 1, 1);
    padded = padded.narrow(d, 1, n);
    auto first = padded.narrow(d, 0, 1), last = padded.narrow(d, n - 1, 1);
    switch (box.boundary(axis)) {
      case FlowBoundary::kPeriodic:
        last.add_(low);
        first.add_(high);
        break;
      case FlowBoundary::kWall:
      case FlowBoundary::kSlip:
        if (!found.wall_velocity.empty()) {
          found.wall_velocity[2 * axis] = add_wall_back(equation, axis, false, low);
          found.wall_velocity[2 * axis + 1] = add_wall_back(equation, axis, true, high);
        }
        first.add_(low, fields.low_sign[axis]);
        last.add_(fields.high_sign[axis] * high);
        break;
      case FlowBoundary::kOpen:
        found.inflow = at::sum_to(2 * low, equation.inflow.sizes());
        first.sub_(low);
        last.add_(high);
        break;
    }
  }
  found.u = padded;
}

}  // namespace

at::Tensor with_boundary_values(const FlowEquation& equation, const at::Tensor& u) {
  const auto& fields = equation.box->fields(u.options());
  const auto inside = fields.free.defined() ? u * fields.free : u;
  return fields.inlet.defined() ? inside + fields.inlet * equation.inflow : inside;
}

BoundaryVjp boundary_values_vjp(const FlowEquation& equation, const at::Tensor& cotangent) {
  const auto& fields = equation.box->fields(cotangent.options());
  return {fields.free.defined() ? cotangent * fields.free : cotangent,
          fields.inlet.defined() ? at::sum_to(cotangent * fields.inlet, equation.inflow.sizes()) : at::Tensor()};
}

at::Tensor with_ghosts(const FlowEquation& equation, const at::Tensor& u) {
  const auto& box = *equation.box;
  const auto& fields = box.fields(u.options());
  auto padded = u;
  for (const int64_t axis : axes_of_ghosts(box)) {
    const int64_t d = axis + 2, n = box.shape()[axis];
    const auto first = padded.narrow(d, 0, 1), last = padded.narrow(d, n - 1, 1);
    switch (box.boundary(axis)) {
      case FlowBoundary::kPeriodic: padded = at::cat({last, padded, first}, d); break;
      case FlowBoundary::kWall:
      case FlowBoundary::kSlip:
        padded = at::cat({add_wall(equation, axis, false, fields.low_sign[axis] * first), padded,
                          add_wall(equation, axis, true, fields.high_sign[axis] * last)},
                         d);
        break;
      case FlowBoundary::kOpen: padded = at::cat({2 * equation.inflow - first, padded, last}, d); break;
    }
  }
  return padded;
}

at::Tensor tendency(const FlowEquation& equation, const at::Tensor& u) {
  const auto& fields = equation.box->fields(u.options());
  const auto padded = with_ghosts(equation, u);
  auto all = flow_has_loops(u) ? advect_and_diffuse(equation, padded.contiguous())
                               : advect_and_diffuse_tensors(equation, padded);
  if (fields.friction.defined()) all = all - equation.nu * fields.friction * u;
  if (equation.force.defined()) all = all + equation.force;
  return fields.free.defined() ? all * fields.free : all;
}

TendencyVjp tendency_vjp(const FlowEquation& equation, const at::Tensor& u, const at::Tensor& cotangent) {
  const auto& fields = equation.box->fields(u.options());
  const auto g = fields.free.defined() ? cotangent * fields.free : cotangent;
  auto [padded_bar, nu_bar] = advect_and_diffuse_vjp(equation, with_ghosts(equation, u).contiguous(), g);
  TendencyVjp found{{}, nu_bar, {}, {}, {}};
  if (equation.force.defined()) found.force = at::sum_to(g, equation.force.sizes());
  ghosts_back(equation, padded_bar, found);
  if (fields.friction.defined()) {
    const auto held = fields.friction * g;
    found.u = found.u - equation.nu * held;
    found.nu = found.nu - equation.nu_gradient(held * u);
  }
  return found;
}

at::Tensor courant_numbers(const FlowEquation& equation, const at::Tensor& u) {
  const at::NoGradGuard no_grad;
  if (flow_has_loops(u)) return courant_numbers_by_loops(equation, u);
  const auto& box = *equation.box;
  at::Tensor sum;
  for (int64_t axis = 0; axis < box.dim(); ++axis) {
    const auto of_axis = u.select(1, box.channel_of(axis)).abs() * (equation.dt / box.dx(axis));
    sum = sum.defined() ? sum + of_axis : of_axis;
  }
  return sum.flatten(1).amax(1);
}

}  // namespace prdp
