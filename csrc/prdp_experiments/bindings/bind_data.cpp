#include <pybind11/functional.h>

#include "prdp_experiments/bindings/bindings.h"
#include "prdp_experiments/data/darcy.h"
#include "prdp_experiments/data/data.h"
#include "prdp_experiments/data/field_problem.h"
#include "prdp_experiments/data/fresh_data.h"

namespace py = pybind11;
using namespace prdp;

void bind_data(py::module_& m) {
  py::class_<Dataset>(m, "Dataset")
      .def_readonly("train_start", &Dataset::train_start)
      .def_readonly("train_between", &Dataset::train_between)
      .def_readonly("train_end", &Dataset::train_end)
      .def_readonly("valid_start", &Dataset::valid_start)
      .def_readonly("valid_end", &Dataset::valid_end);
  m.def("make_dataset", &make_dataset, py::arg("scene"), py::arg("on_progress") = OnProgress(),
        py::call_guard<py::gil_scoped_release>());
  py::class_<FreshData>(m, "FreshData")
      .def(py::init<Scene, Dataset>(), py::arg("scene"), py::arg("first"))
      .def("epoch", &FreshData::epoch, py::arg("number"), py::call_guard<py::gil_scoped_release>());
  m.def("validation_trajectories", &validation_trajectories, py::arg("scene"), py::arg("steps"),
        py::arg("on_progress") = OnProgress(), py::call_guard<py::gil_scoped_release>());
  m.def("all_trajectories", &all_trajectories, py::arg("scene"), py::arg("steps"),
        py::arg("on_progress") = OnProgress(), py::call_guard<py::gil_scoped_release>());
  py::class_<ParameterProblem>(m, "ParameterProblem")
      .def_readonly("modes", &ParameterProblem::modes)
      .def_readonly("start", &ParameterProblem::start)
      .def_readonly("reference", &ParameterProblem::reference)
      .def_readonly("solution", &ParameterProblem::solution);
  m.def("make_parameter_problem", &make_parameter_problem, py::arg("scene"), py::call_guard<py::gil_scoped_release>());
  py::class_<FieldProblem>(m, "FieldProblem")
      .def_readonly("start", &FieldProblem::start)
      .def_readonly("snapshots", &FieldProblem::snapshots)
      .def_readonly("theta", &FieldProblem::theta)
      .def_readonly("reference", &FieldProblem::reference);
  m.def("make_field_problem", &make_field_problem, py::arg("scene"), py::arg("seed"),
        py::call_guard<py::gil_scoped_release>());
  m.def(
      "diffusion_stencil",
      [](const at::Tensor& kappa, double dt, const std::vector<double>& lengths) {
        const auto stencil = diffusion_stencil(kappa, dt, lengths);
        return std::make_pair(stencil.coefficients, stencil.offsets);
      },
      py::arg("kappa"), py::arg("dt"), py::arg("lengths") = std::vector<double>());
  m.attr("DARCY_SOURCE") = kDarcySource;
  m.def("observed", &observed, py::arg("states"), py::arg("scene"));
  m.def("roughness", &roughness, py::arg("theta"), py::arg("physics"));
}
