#pragma once
#include <torch/csrc/utils/pybind.h>

#include "prdp/controller/prdp_controller.h"

/// What both Python modules need.

/// Turns the library's exceptions into the Python errors that torch would raise, without a C++ backtrace.
inline void translate_errors() {
  pybind11::register_local_exception_translator([](std::exception_ptr p) {
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
}

inline pybind11::dict as_dict(const prdp::PRDPSettings& s) {
  using namespace pybind11::literals;
  return pybind11::dict("tau_step"_a = s.tau_step, "tau_stop"_a = s.tau_stop, "delta"_a = s.delta,
                        "window"_a = s.window, "initial"_a = s.initial, "increment"_a = s.increment,
                        "maximum"_a = s.maximum, "growth"_a = s.growth, "adjoint_ratio"_a = s.adjoint_ratio);
}
