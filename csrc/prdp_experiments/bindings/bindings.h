#pragma once
#include <torch/csrc/utils/pybind.h>

void bind_files(pybind11::module_& m);
void bind_scenes(pybind11::module_& m);
void bind_data(pybind11::module_& m);
void bind_training(pybind11::module_& m);
