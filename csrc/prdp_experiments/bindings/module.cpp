#include "bindings/convert.h"
#include "prdp_experiments/bindings/bindings.h"

PYBIND11_MODULE(_C, m) {
  translate_errors();
  bind_files(m);
  bind_scenes(m);
  bind_data(m);
  bind_training(m);
}
