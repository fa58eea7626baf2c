#include "prdp/steppers/flow/kernels.h"

#include <ATen/core/grad_mode.h>

#include "prdp/gpu/device/flow_pressure.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/steppers/flow/kernel_fields.h"
#include "prdp/steppers/flow/limits.h"

namespace prdp::flow_kernels {

namespace {

constexpr const char *kFlow = "prdp/gpu/device/flow.h", *kPressure = "prdp/gpu/device/flow_pressure.h";

template <class T>
gpu::FlowVelocity<T> velocity_of(const FlowBox& box, const UncorrectedVelocity& of, const at::Tensor& like) {
  return {.grid = grid_of(box),
          .base = field_of<const T>(of.base),
          .added = field_of<const T>(of.added),
          .free = field_of<const T>(box.fields(like.options()).free),
          .refused = data_of<const int64_t>(of.refused),
          .status_of_solve = data_of<const int64_t>(of.status_of_solve)};
}

template <class T>
gpu::FlowClosedParts<T> parts_of(const FlowBox& box, const at::Tensor& like) {
  const auto& parts = box.fields(like.options()).closed_parts;
  if (!parts.defined()) return {nullptr, 0, 0};
  if (parts.numel() == 0) return {nullptr, 0, 1};
  return {data_of<const T>(parts), step_of_samples(parts), static_cast<int>(parts.size(1))};
}

template <class T>
gpu::FlowShare<T> share_of(const UncorrectedVelocity& of) {
  return {number_of<T>(of.share_by_nu), number_of(of.largest_nu)};
}

const at::Tensor& velocity_like(const UncorrectedVelocity& of) { return of.base.defined() ? of.base : of.added[0]; }

}  // namespace

bool can_run(const at::Tensor& u) {
  return gpu::runtime_of(u.device()) && !at::GradMode::is_enabled() && is_plain(u) && u.numel() > 0;
}

std::optional<PaddedVelocity> pad_velocity(const FlowEquation& e, const at::Tensor& u) {
  if (!can_run(u)) return std::nullopt;
  const auto& box = *e.box;
  const auto& fields = box.fields(u.options());
  const int64_t d = box.dim(), batch = u.size(0);
  std::vector<int64_t> sizes{batch, d};
  for (const int64_t n : box.shape()) sizes.push_back(n + 2);
  PaddedVelocity found{{}, at::empty(sizes, u.options()), at::empty({batch}, u.options().dtype(at::kLong))};
  found.velocity = found.padded;
  for (int64_t axis = 0; axis < d; ++axis) found.velocity = found.velocity.narrow(axis + 2, 1, box.shape()[axis]);
  const bool launched = each_sample({"FlowStart", kFlow}, u, d * cells_of(box), [&]<class T>(T) {
    gpu::FlowStart<T> of{.boundary = {.grid = grid_of(box),
                                      .u = field_of<const T>(u),
                                      .free = field_of<const T>(fields.free),
                                      .inlet = field_of<const T>(fields.inlet),
                                      .inflow = field_of<const T>(e.inflow),
                                      .walls = {}},
                         .force = field_of<const T>(e.force),
                         .nu = number_of<T>(e.nu),
                         .dt = e.dt,
                         .limit = courant_limit(e),
                         .padded = field_of<T>(found.padded),
                         .status = data_of<int64_t>(found.status)};
    for (int64_t axis = 0; axis < d; ++axis)
      for (const bool high : {false, true})
        of.boundary.walls[2 * (axis + 3 - d) + high] = field_of<const T>(e.velocity_of_wall(axis, high));
    return of;
  });
  return launched ? std::optional(found) : std::nullopt;
}

at::Tensor change(const FlowEquation& e, const PaddedVelocity& start) {
  const auto out = by_channels(start.velocity, *e.box);
  const bool launched = each_point({"FlowChange", kFlow}, out, out.numel(), [&]<class T>(T) {
    return gpu::FlowChange<T>{.terms = terms_of<T>(e, start.padded),
                              .force = field_of<const T>(e.force),
                              .status = data_of<const int64_t>(start.status),
                              .change = field_of<T>(out)};
  });
  return launched ? out : at::Tensor();
}

at::Tensor divergence(const FlowBox& box, const UncorrectedVelocity& correction, double factor, bool for_a_solve) {
  const auto& like = velocity_like(correction);
  const auto& fields = box.fields(like.options());
  const auto b = at::empty(sizes_of_potential(like, box), like.options());
  const bool launched = each_sample({"FlowDivergence", kPressure}, like, cells_of(box), [&]<class T>(T) {
    return gpu::FlowDivergence<T>{.u = velocity_of<T>(box, correction, like),
                                  .cells = field_of<const T>(fields.cells),
                                  .potential_bar = field_of<const T>(correction.potential_bar),
                                  .parts = parts_of<T>(box, like),
                                  .share = share_of<T>(correction),
                                  .factor = factor,
                                  .for_a_solve = for_a_solve,
                                  .b = data_of<T>(b)};
  });
  return launched ? b : at::Tensor();
}

std::optional<Corrected> correct(const FlowBox& box, const UncorrectedVelocity& correction, const at::Tensor& found,
                                 const CorrectionOptions& how) {
  const auto& like = velocity_like(correction);
  const auto solution = found.contiguous(), phi = at::empty_like(solution);
  const auto before = how.before.defined() ? how.before.contiguous() : how.before;
  const bool own_potential = before.defined() || correction.share_by_nu.defined();
  Corrected result{by_channels(like, box), how.wants_on_free_faces ? by_channels(like, box) : at::Tensor(),
                   own_potential ? at::empty_like(solution) : phi};
  const bool launched = each_sample({"FlowCorrection", kPressure}, like, cells_of(box), [&]<class T>(T) {
    return gpu::FlowCorrection<T>{.u = velocity_of<T>(box, correction, like),
                                  .cells = field_of<const T>(box.fields(like.options()).cells),
                                  .parts = parts_of<T>(box, like),
                                  .share = share_of<T>(correction),
                                  .factor = how.factor,
                                  .on_all_faces = how.on_all_faces,
                                  .found = data_of<const T>(solution),
                                  .before = data_of<const T>(before),
                                  .phi = data_of<T>(phi),
                                  .potential = own_potential ? data_of<T>(result.potential) : nullptr,
                                  .out = field_of<T>(result.u),
                                  .on_free_faces = field_of<T>(result.on_free_faces)};
  });
  return launched ? std::optional(result) : std::nullopt;
}

at::Tensor diffusion_coefficients(const FlowEquation& e, const at::Tensor& like) {
  const auto& patterns = e.box->fields(like.options()).diffusion;
  auto sizes = patterns[0].sizes().vec();
  sizes[0] = std::max(sizes[0], e.nu.numel());
  sizes.insert(sizes.begin(), static_cast<int64_t>(patterns.size()));
  const auto out = at::empty(sizes, like.options());
  const bool launched = each_point({"FlowDiffusionEntries", kFlow}, out, out.numel(), [&]<class T>(T) {
    gpu::FlowDiffusionEntries<T> of{.patterns = {},
                                    .sample = step_of_samples(patterns[0]),
                                    .nu = number_of<T>(e.nu),
                                    .dt = e.dt,
                                    .samples = static_cast<int>(sizes[1]),
                                    .entries = static_cast<int>(sizes[2]),
                                    .cells = static_cast<int>(cells_of(*e.box)),
                                    .out = data_of<T>(out)};
    for (size_t k = 0; k < patterns.size(); ++k) of.patterns[k] = data_of<const T>(patterns[k]);
    return of;
  });
  return launched ? out : at::Tensor();
}

std::optional<SolveInfo> joined_reports(const std::vector<SolveInfo>& infos, const at::Tensor& refused) {
  const auto& first = infos[0];
  if (!can_run(first.residual) || infos.size() > gpu::FlowReport<float>::kMost) return std::nullopt;
  const auto like = [](const at::Tensor& t) { return at::empty_like(t, at::MemoryFormat::Contiguous); };
  SolveInfo all{like(first.iterations), like(first.residual), like(first.status), like(first.operator_applications),
                like(first.floor)};
  const int64_t samples = first.residual.size(0);
  const bool launched = each_point({"FlowReport", kFlow}, first.residual, samples, [&]<class T>(T) {
    gpu::FlowReport<T> of{};
    of.solves = static_cast<int>(infos.size());
    for (size_t k = 0; k < infos.size(); ++k) {
      of.iterations[k] = data_of<const int64_t>(infos[k].iterations);
      of.statuses[k] = data_of<const int64_t>(infos[k].status);
      of.applications[k] = data_of<const int64_t>(infos[k].operator_applications);
      of.residuals[k] = data_of<const T>(infos[k].residual);
      of.floors[k] = data_of<const T>(infos[k].floor);
    }
    of.refused = data_of<const int64_t>(refused);
    of.iterations_out = data_of<int64_t>(all.iterations);
    of.status_out = data_of<int64_t>(all.status);
    of.applications_out = data_of<int64_t>(all.operator_applications);
    of.residual_out = data_of<T>(all.residual);
    of.floor_out = data_of<T>(all.floor);
    return of;
  });
  return launched ? std::optional(all) : std::nullopt;
}

}  // namespace prdp::flow_kernels
