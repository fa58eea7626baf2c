#include <torch/csrc/Exceptions.h>

#include "bindings.h"
#include "prdp/operators/autocast.h"
#include "prdp/steppers/flow/boundaries.h"
#include "prdp/steppers/flow/flow.h"
#include "prdp/steppers/flow/rollout.h"
#include "solves.h"

namespace py = pybind11;
using namespace prdp;

namespace {

std::shared_ptr<FlowBox> make_box(std::vector<int64_t> shape, const std::vector<std::string>& boundary,
                                  const std::vector<double>& length, std::optional<at::Tensor> obstacle) {
  std::vector<FlowBoundary> of_axes;
  for (const auto& name : boundary) of_axes.push_back(flow_boundary_from_name(name));
  return std::make_shared<FlowBox>(std::move(shape), of_axes, length, obstacle.value_or(at::Tensor()));
}

FlowEquation make_equation(std::shared_ptr<const FlowBox> box, double dt, at::Tensor nu,
                           std::optional<at::Tensor> force, std::optional<at::Tensor> inflow,
                           const std::vector<std::optional<at::Tensor>>& wall_velocity, const std::string& advection,
                           const std::string& diffusion, const std::string& pressure) {
  std::vector<at::Tensor> walls;
  for (const auto& velocity : wall_velocity) walls.push_back(velocity.value_or(at::Tensor()));
  return {std::move(box),
          dt,
          std::move(nu),
          force.value_or(at::Tensor()),
          inflow.value_or(at::Tensor()),
          std::move(walls),
          flow_advection_from_name(advection),
          flow_diffusion_from_name(diffusion),
          flow_pressure_from_name(pressure)};
}

/// The result of a call, with the errors that torch would raise.
template <class Call>
auto without_lock(const Call& call) {
  HANDLE_TH_ERRORS
  const py::gil_scoped_release no_gil;
  const WithoutAutocast full_precision;
  return call();
  END_HANDLE_TH_ERRORS_PYBIND
}

template <class Solve>
py::tuple report(const Solve& solve) {
  return as_tuple(without_lock(solve));
}

}  // namespace

void bind_flow(py::module_& m) {
  py::class_<FlowBox, std::shared_ptr<FlowBox>>(m, "FlowBox", "The grid of a flow, its boundary and its obstacle.")
      .def(py::init(&make_box), py::arg("shape"), py::arg("boundary"), py::arg("length"), py::arg("obstacle"))
      .def("fill_pockets", &fill_pockets, py::arg("obstacle"));
  py::class_<FlowEquation>(m, "FlowEquation", "A flow and how it is stepped.")
      .def(py::init(&make_equation), py::arg("box"), py::arg("dt"), py::arg("nu"), py::arg("force"), py::arg("inflow"),
           py::arg("wall_velocity"), py::arg("advection"), py::arg("diffusion"), py::arg("pressure"))
      .def("check", [](const FlowEquation& e) { e.check(); })
      .def(
          "step",
          [](const FlowEquation& e, const at::Tensor& u, const SolveOptions& options, int64_t k, int64_t log) {
            return report([&] { return flow_next(e, u, with(options, k, log)); });
          },
          py::arg("u"), py::arg("options"), py::arg("max_iter"), py::arg("adjoint_log"))
      .def(
          "step_and_pressure",
          [](const FlowEquation& e, const at::Tensor& u, const SolveOptions& options, int64_t k, int64_t log) {
            return report([&] { return flow_next_and_pressure(e, u, with(options, k, log)); });
          },
          py::arg("u"), py::arg("options"), py::arg("max_iter"), py::arg("adjoint_log"))
      .def(
          "rollout",
          [](const FlowEquation& e, const at::Tensor& u, int64_t steps, const SolveOptions& options, int64_t k,
             int64_t log) { return report([&] { return flow_rollout(e, u, steps, with(options, k, log)); }); },
          py::arg("u"), py::arg("steps"), py::arg("options"), py::arg("max_iter"), py::arg("adjoint_log"))
      .def(
          "project",
          [](const FlowEquation& e, const at::Tensor& u, const SolveOptions& options, int64_t k) {
            return without_lock([&] { return flow_project(e, u, with(options, k, 0)); });
          },
          py::arg("u"), py::arg("options"), py::arg("max_iter"))
      .def(
          "pressure",
          [](const FlowEquation& e, const at::Tensor& u, const SolveOptions& options, int64_t k) {
            return without_lock([&] { return flow_pressure(e, u, with(options, k, 0)); });
          },
          py::arg("u"), py::arg("options"), py::arg("max_iter"))
      .def(
          "divergence",
          [](const FlowEquation& e, const at::Tensor& u) {
            return without_lock([&] { return flow_divergence_of_state(e, u); });
          },
          py::arg("u"));
}
