#include "bindings.h"

namespace py = pybind11;

PYBIND11_MODULE(_C, m) {
  // The library's errors as the Python errors that torch makes of them, without a C++ backtrace.
  py::register_local_exception_translator([](std::exception_ptr p) {
    try {
      if (p) std::rethrow_exception(p);
    } catch (const c10::ValueError& e) {
      PyErr_SetString(PyExc_ValueError, e.what_without_backtrace());
    } catch (const c10::TypeError& e) {
      PyErr_SetString(PyExc_TypeError, e.what_without_backtrace());
    } catch (const c10::Error& e) {
      PyErr_SetString(PyExc_RuntimeError, e.what_without_backtrace());
    }
  });
  m.attr("VERSION") = PRDP_VERSION;
  bind_solvers(m);
  bind_steps(m);
  bind_controllers(m);
  bind_scenes(m);
}
