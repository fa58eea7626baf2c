#include "prdp/operators/navier_stokes_operator.h"
#include "prdp_experiments/bindings/bindings.h"
#include "prdp_experiments/training/failures.h"
#include "prdp_experiments/training/loss.h"

namespace py = pybind11;
using namespace prdp;

void bind_training(py::module_& m) {
  m.def("loss", &loss, py::arg("kind"), py::arg("u"), py::arg("reference"));
  py::class_<Failures>(m, "Failures")
      .def(py::init<>())
      .def("take", &Failures::take, py::arg("forward"), py::arg("adjoint"), py::arg("samples"))
      .def_property_readonly("count", &Failures::count)
      .def("line", &Failures::line, py::arg("interval"));
  m.def("normalised_mse", &normalised_mse, py::arg("u"), py::arg("reference"));
  m.def("without_mean_pressure", &without_mean_pressure, py::arg("u"));
  m.def("half_mse", &half_mse, py::arg("u"), py::arg("reference"));
  m.def("relative_error", &relative_error, py::arg("theta"), py::arg("reference"));
  m.def("why_lost", &why_lost, py::arg("first"), py::arg("last"));
}
