#include "prdp/steppers/flow/boundaries.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <deque>

#include "prdp/error_text.h"

namespace prdp {

namespace {

/// The parts of the fluid that are connected through free faces.
struct Parts {
  std::vector<int64_t> of_cell;  // -1 in solid cells
  int64_t count = 0;
};

int64_t stride(const FlowBox& box, int64_t axis) {
  int64_t cells = 1;
  for (int64_t later = axis + 1; later < box.dim(); ++later) cells *= box.shape()[later];
  return cells;
}
int64_t position(const FlowBox& box, int64_t cell, int64_t axis) {
  return cell / stride(box, axis) % box.shape()[axis];
}

/// The neighbour of a cell along an axis, to the `side` 1 or -1; -1 beyond an end.
int64_t cell_beside(const FlowBox& box, int64_t cell, int64_t axis, int64_t side) {
  const int64_t n = box.shape()[axis], at = position(box, cell, axis), to = at + side;
  if (to >= 0 && to < n) return cell + side * stride(box, axis);
  return box.boundary(axis) == FlowBoundary::kPeriodic ? cell - side * (n - 1) * stride(box, axis) : -1;
}

Parts find_parts(const FlowBox& box, const at::Tensor& fluid) {
  const auto* is_fluid = fluid.const_data_ptr<bool>();
  Parts parts{std::vector<int64_t>(fluid.numel(), -1)};
  for (int64_t first = 0; first < fluid.numel(); ++first) {
    if (!is_fluid[first] || parts.of_cell[first] >= 0) continue;
    std::deque<int64_t> queue{first};
    parts.of_cell[first] = parts.count;
    for (; !queue.empty(); queue.pop_front())
      for (int64_t axis = 0; axis < box.dim(); ++axis)
        for (const int64_t side : {-1, 1}) {
          const int64_t next = cell_beside(box, queue.front(), axis, side);
          if (next < 0 || !is_fluid[next] || parts.of_cell[next] >= 0) continue;
          parts.of_cell[next] = parts.count;
          queue.push_back(next);
        }
    ++parts.count;
  }
  return parts;
}

/// Which parts have cells at the low end of the open axis, and at the high end; none without one.
struct OpenEnds {
  std::vector<bool> inlet, outlet;
};
OpenEnds open_ends(const FlowBox& box, const Parts& parts) {
  const int64_t open = box.open_axis();
  OpenEnds ends{std::vector<bool>(parts.count), std::vector<bool>(parts.count)};
  const auto cells = static_cast<int64_t>(parts.of_cell.size());
  for (int64_t cell = 0; cell < cells && open >= 0; ++cell) {
    if (parts.of_cell[cell] < 0) continue;
    if (position(box, cell, open) == 0) ends.inlet[parts.of_cell[cell]] = true;
    if (position(box, cell, open) == box.shape()[open] - 1) ends.outlet[parts.of_cell[cell]] = true;
  }
  return ends;
}

/// The parts without an open end, (parts, *shape). `whose` obstacle it is, for errors.
at::Tensor find_closed_parts(const FlowBox& box, const at::Tensor& fluid, const std::string& whose) {
  const auto parts = find_parts(box, fluid);
  const auto [inlet, outlet] = open_ends(box, parts);
  const auto numbers = at::tensor(parts.of_cell, at::kLong).reshape(box.shape());
  std::vector<at::Tensor> closed{at::empty(box.shape(), at::kDouble).unsqueeze(0).narrow(0, 0, 0)};
  for (int64_t p = 0; p < parts.count; ++p) {
    TORCH_CHECK_VALUE(
        !inlet[p] || outlet[p], "Flow: the obstacle", whose,
        " keeps fluid that comes in at the open end from going out at the other; make the cells before it "
        "solid, as with ",
        in_language("Flow.fill_pockets", "fill_pockets()"), ", or open a way");
    const auto cells_of_part = numbers.eq(p);
    // The pressure of a cell without a free face is known.
    if (!outlet[p] && cells_of_part.sum().item<int64_t>() > 1)
      closed.push_back(cells_of_part.to(at::kDouble).unsqueeze(0));
  }
  return at::cat(closed);
}

/// The coefficient of each neighbour, low and high along each axis, behind that of the point itself.
at::Tensor coefficients(const at::Tensor& diagonal, const std::vector<at::Tensor>& of_neighbours) {
  std::vector<at::Tensor> all{diagonal};
  all.insert(all.end(), of_neighbours.begin(), of_neighbours.end());
  return at::stack(all).unsqueeze(0);
}

/// -div grad of the pressure times dx² of the last axis: 1 on free faces, 0 on others. Where the pressure is known, its
/// row has a diagonal alone, of the size of the others.
struct PressureCoefficients {
  at::Tensor coefficients;
  at::Tensor known;  // (*shape): where it is, also in cells without a free face
};
PressureCoefficients pressure_coefficients(const FlowBox& box, const at::Tensor& free, at::Tensor known) {
  auto diagonal = at::zeros(box.shape(), at::kDouble);
  std::vector<at::Tensor> open;
  for (int64_t axis = 0; axis < box.dim(); ++axis) {
    const double ratio = box.dx(box.dim() - 1) / box.dx(axis);
    const auto low = free[box.channel_of(axis)] * (ratio * ratio);
    open.push_back(low);
    open.push_back(neighbour(box, low, axis, 1, 0.0));
    diagonal = diagonal + open[open.size() - 2] + open.back();
  }
  known = known.logical_or(diagonal.eq(0));  // a cell without a free face has no pressure to speak of
  const auto unknown = known.logical_not().to(at::kDouble);
  std::vector<at::Tensor> of_neighbours;
  for (int64_t k = 0; k < 2 * box.dim(); ++k)
    of_neighbours.push_back(-open[k] * unknown * neighbour(box, unknown, k / 2, k % 2 ? 1 : -1, 0.0));
  return {coefficients(at::where(known, at::full({}, 4.0, at::kDouble), diagonal), of_neighbours), known};
}

/// -Δ of the component along `along`, for values that are zero on all faces which are not free. `inside`: faces inside
/// an obstacle; its surface, where the velocity is zero, is half a cell from the free faces beside them.
at::Tensor diffusion_coefficients(const FlowBox& box, int64_t along, const at::Tensor& free, const at::Tensor& inside) {
  auto diagonal = at::zeros(box.shape(), at::kDouble);
  std::vector<at::Tensor> of_neighbours;
  for (int64_t axis = 0; axis < box.dim(); ++axis)
    for (const int64_t side : {-1, 1}) {
      const double coupling = 1.0 / (box.dx(axis) * box.dx(axis));
      // A wall or an inlet along the face's own axis is a whole cell away, along the others half a cell.
      const bool outlet = box.boundary(axis) == FlowBoundary::kOpen && side > 0;
      const bool slips = box.boundary(axis) == FlowBoundary::kSlip && axis != along;
      const double beyond = outlet || slips ? 0.0 : axis == along ? 1.0 : 2.0;
      const auto weight = neighbour(box, at::ones(box.shape(), at::kDouble), axis, side, beyond);
      const auto behind = axis == along ? at::zeros_like(weight) : neighbour(box, inside, axis, side, 0.0);
      diagonal = diagonal + coupling * (weight + behind) * free;
      of_neighbours.push_back(-coupling * free * neighbour(box, free, axis, side, 0.0));
    }
  return coefficients(diagonal, of_neighbours);
}

/// What the faces at the low ends of cells are, (d, *shape): 1 where the name holds, else 0.
struct FaceMasks {
  at::Tensor free, inlet;
  at::Tensor inside;  // an obstacle
};
FaceMasks make_face_masks(const FlowBox& box, const at::Tensor& fluid) {
  std::vector<at::Tensor> free(box.dim()), inlet(box.dim()), inside(box.dim());
  for (int64_t axis = 0; axis < box.dim(); ++axis) {
    const int64_t c = box.channel_of(axis);
    free[c] = fluid * neighbour(box, fluid, axis, -1, 0.0);
    inside[c] = (1 - fluid) * (1 - neighbour(box, fluid, axis, -1, 1.0));
    inlet[c] = at::zeros_like(fluid);
    if (axis == box.open_axis()) inlet[c].narrow(axis, 0, 1).copy_(fluid.narrow(axis, 0, 1));
  }
  return {at::stack(free), at::stack(inlet), at::stack(inside)};
}

/// 1/dx² for each neighbour of a free face that lies inside an obstacle, (d, *shape).
at::Tensor friction_coefficients(const FlowBox& box, const FaceMasks& faces) {
  auto friction = at::zeros_like(faces.free);
  for (int64_t along = 0; along < box.dim(); ++along)
    for (int64_t axis = 0; axis < box.dim(); ++axis)
      for (const int64_t side : {-1, 1}) {
        if (axis == along) continue;
        const int64_t c = box.channel_of(along);
        friction[c] += faces.free[c] * neighbour(box, faces.inside[c], axis, side, 0.0) / (box.dx(axis) * box.dx(axis));
      }
  return friction;
}

/// By what the velocity beside a wall of this axis is multiplied beyond it.
double sign_beyond_wall(const FlowBox& box, int64_t axis) {
  return box.boundary(axis) == FlowBoundary::kSlip ? 1.0 : -1.0;
}
/// The same of a high wall, (d, 1, …): its own component is zero on the wall.
at::Tensor signs_beyond_high_wall(const FlowBox& box, int64_t axis) {
  auto signs = at::full({box.dim()}, sign_beyond_wall(box, axis), at::kDouble);
  signs[box.channel_of(axis)] = 0.0;
  std::vector<int64_t> shape(box.dim() + 1, 1);
  shape[0] = box.dim();
  return signs.reshape(shape);
}

/// (samples, cells) of closed parts (samples, parts, *shape).
at::Tensor number_of_part(const at::Tensor& parts) {
  const auto in_part = parts.flatten(2).ne(0);
  return at::where(in_part.any(1), in_part.to(at::kByte).argmax(1) + 1, 0);
}

bool all_ones(const at::Tensor& mask) { return mask.eq(1).all().item<bool>(); }

/// Of the box with these cells of fluid, (*shape): the masks are all there.
FlowFields fields_with(const FlowBox& box, const at::Tensor& fluid, const std::string& whose) {
  const int64_t open = box.open_axis();
  TORCH_CHECK_VALUE(fluid.any().item<bool>(), "Flow: the obstacle", whose,
                    " fills the grid; at least one cell must be fluid");
  const auto faces = make_face_masks(box, fluid.to(at::kDouble));
  FlowFields fields;
  for (int64_t c = 0; c < box.dim(); ++c)
    fields.diffusion.push_back(diffusion_coefficients(box, box.dim() - 1 - c, faces.free[c], faces.inside[c]));
  auto given = fluid.logical_not();
  if (open >= 0) given.narrow(open, box.shape()[open] - 1, 1).fill_(true);
  const auto pressure = pressure_coefficients(box, faces.free, given);
  fields.pressure = pressure.coefficients;
  fields.cells = pressure.known.logical_not().to(at::kDouble).unsqueeze(0).unsqueeze(0);
  fields.free = faces.free.unsqueeze(0);
  fields.inlet = faces.inlet.unsqueeze(0);
  fields.friction = friction_coefficients(box, faces).unsqueeze(0);
  fields.closed_parts = find_closed_parts(box, fluid, whose).unsqueeze(0);
  return fields;
}

/// The fields of several boxes as those of samples.
FlowFields of_samples(const std::vector<FlowFields>& boxes) {
  if (boxes.size() == 1) return boxes[0];
  const auto stacked = [&](const auto& part) {
    std::vector<at::Tensor> all;
    for (const auto& box : boxes) all.push_back(part(box));
    return at::cat(all);
  };
  FlowFields fields;
  for (auto part :
       {&FlowFields::cells, &FlowFields::free, &FlowFields::inlet, &FlowFields::friction, &FlowFields::pressure})
    fields.*part = stacked([&](const FlowFields& box) { return box.*part; });
  for (size_t c = 0; c < boxes[0].diffusion.size(); ++c)
    fields.diffusion.push_back(stacked([&](const FlowFields& box) { return box.diffusion[c]; }));
  int64_t most = 0;
  for (const auto& box : boxes) most = std::max(most, box.closed_parts.size(1));
  fields.closed_parts = stacked([&](const FlowFields& box) {
    auto sizes = box.closed_parts.sizes().vec();
    sizes[1] = most - sizes[1];
    return at::cat({box.closed_parts, at::zeros(sizes, at::kDouble)}, 1);
  });
  return fields;
}

}  // namespace

void check_obstacle(const at::Tensor& obstacle, at::IntArrayRef shape) {
  TORCH_CHECK_TYPE(obstacle.scalar_type() == at::kBool,
                   "Flow: obstacle must be a bool tensor, true in solid cells, got ",
                   dtype_name(obstacle.scalar_type()));
  const auto sizes = obstacle.sizes();
  const bool fits = sizes == shape || (sizes.size() == shape.size() + 1 && sizes.slice(1) == shape);
  TORCH_CHECK_VALUE(fits, "Flow: obstacle must have the shape of the grid, ", shape, ", or (batch or 1) of them, got ",
                    sizes);
}

at::Tensor fill_pockets(const FlowBox& box, const at::Tensor& obstacle) {
  check_obstacle(obstacle, box.shape());
  const bool is_of_samples = obstacle.dim() > box.dim();
  auto filled = obstacle.to(at::kCPU, /*non_blocking=*/false, /*copy=*/true).contiguous();
  for (auto& solid : (is_of_samples ? filled : filled.unsqueeze(0)).unbind()) {
    const auto parts = find_parts(box, solid.logical_not());
    TORCH_CHECK_VALUE(parts.count > 0, "Flow: the obstacle fills the grid; at least one cell must be fluid");
    std::vector<int64_t> cells(parts.count);
    for (const int64_t part : parts.of_cell)
      if (part >= 0) ++cells[part];
    const int64_t largest = std::max_element(cells.begin(), cells.end()) - cells.begin();
    const auto [inlet, outlet] = open_ends(box, parts);
    const auto flows = [&](int64_t part) {
      return part >= 0 && (box.open_axis() < 0 ? part == largest : inlet[part] && outlet[part]);
    };
    auto* values = solid.mutable_data_ptr<bool>();
    for (size_t i = 0; i < parts.of_cell.size(); ++i) values[i] = !flows(parts.of_cell[i]);
    TORCH_CHECK_VALUE(!solid.all().item<bool>(), "Flow: the obstacle leaves no way from the open end to the other");
  }
  return filled.to(obstacle.device());
}

FlowFields make_flow_fields(const FlowBox& box) {
  const at::NoGradGuard no_grad;
  const bool has_obstacle = box.obstacle().defined();
  const auto fluid = has_obstacle ? box.obstacle().logical_not() : at::ones(box.shape(), at::kBool).unsqueeze(0);
  std::vector<FlowFields> boxes;
  for (int64_t s = 0; s < fluid.size(0); ++s)
    boxes.push_back(fields_with(box, fluid[s], fluid.size(0) > 1 ? " of sample " + std::to_string(s) : ""));
  auto fields = of_samples(boxes);
  for (int64_t axis = 0; axis < box.dim(); ++axis) {
    fields.low_sign.push_back(sign_beyond_wall(box, axis));
    fields.high_sign.push_back(signs_beyond_high_wall(box, axis));
  }
  if (box.open_axis() < 0) fields.inlet = at::Tensor();
  if (!has_obstacle) fields.friction = at::Tensor();
  if (!has_obstacle && box.open_axis() < 0) fields.closed_parts = at::empty({0}, at::kDouble);
  else if (fields.closed_parts.numel() == 0) fields.closed_parts = at::Tensor();
  else fields.part_of_cell = number_of_part(fields.closed_parts);
  const auto is_free = fields.free.flatten(1).eq(1).all(1);
  if (all_ones(fields.free)) fields.diffusion.resize(1);  // periodic, no obstacle: all components are alike
  else if (is_free.any().item<bool>()) fields.is_free = is_free;
  for (auto* mask : {&fields.cells, &fields.free})
    if (all_ones(*mask)) *mask = at::Tensor();
  return fields;
}

}  // namespace prdp
