#include "bindings.h"
#include "convert.h"
#include "prdp/error_text.h"

namespace py = pybind11;

PYBIND11_MODULE(_C, m) {
  prdp::speak_python();
  translate_errors();
  m.attr("VERSION") = PRDP_VERSION;
  m.def("sentence", &prdp::sentence, py::arg("what"));
  bind_solvers(m);
  bind_steps(m);
  bind_flow(m);
  bind_controllers(m);
}
