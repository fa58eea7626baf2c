#pragma once
#include <torch/csrc/utils/pybind.h>

/// One function a room of the library.
void bind_solvers(pybind11::module_& m);
void bind_steps(pybind11::module_& m);
void bind_flow(pybind11::module_& m);
void bind_controllers(pybind11::module_& m);
