#pragma once
#include <torch/csrc/utils/pybind.h>

#include "prdp/controller/prdp_controller.h"

pybind11::dict as_dict(const prdp::PRDPSettings& settings);

/// One function a room of the library.
void bind_solvers(pybind11::module_& m);
void bind_steps(pybind11::module_& m);
void bind_controllers(pybind11::module_& m);
void bind_scenes(pybind11::module_& m);
