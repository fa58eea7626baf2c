#include <pybind11/stl/filesystem.h>

#include "bindings/convert.h"
#include "prdp_experiments/bindings/bindings.h"
#include "prdp_experiments/data/kolmogorov.h"
#include "prdp_experiments/scenes/device.h"
#include "prdp_experiments/scenes/scene.h"

namespace py = pybind11;
using namespace prdp;

namespace {

/// The tables of a scene file.
void bind_tables(py::module_& m) {
  py::class_<Scene::Physics>(m, "Physics")
      .def_readonly("equation", &Scene::Physics::equation)
      .def_readonly("shape", &Scene::Physics::shape)
      .def_readonly("nu", &Scene::Physics::nu)
      .def_readonly("dt", &Scene::Physics::dt)
      .def_property_readonly(
          "force", [](const Scene::Physics& p) { return p.is_kolmogorov() ? kolmogorov_force(p) : at::Tensor(); })
      .def_property_readonly("length",
                             [](const Scene::Physics& p) {
                               return p.lengths.empty() ? std::vector<double>(p.shape.size(), 1.0) : p.lengths;
                             })
      .def_property_readonly("channels", &Scene::Physics::channels)
      .def_property_readonly("periodic", &Scene::Physics::periodic)
      .def_property_readonly("direct_is_cheap", &Scene::Physics::direct_is_cheap);
  py::class_<Scene::Data>(m, "Data")
      .def_readonly("file", &Scene::Data::file)
      .def_readonly("fresh", &Scene::Data::fresh)
      .def_readonly("modes", &Scene::Data::modes)
      .def_readonly("train", &Scene::Data::train)
      .def_readonly("valid", &Scene::Data::valid)
      .def_readonly("seed", &Scene::Data::seed)
      .def_readonly("trained_steps", &Scene::Data::trained_steps)
      .def_readonly("valid_steps", &Scene::Data::valid_steps)
      .def_readonly("valid_max_iter", &Scene::Data::valid_max_iter)
      .def_readonly("reference_shape", &Scene::Data::reference_shape);
  py::class_<Scene::Network>(m, "Network")
      .def_readonly("python", &Scene::Network::python)
      .def_readonly("kind", &Scene::Network::kind)
      .def_readonly("hidden", &Scene::Network::hidden)
      .def_readonly("blocks", &Scene::Network::blocks)
      .def_readonly("levels", &Scene::Network::levels)
      .def_readonly("width", &Scene::Network::width)
      .def_readonly("zero_output", &Scene::Network::zero_output);
  py::class_<Scene::Training>(m, "Training")
      .def_readonly("loss", &Scene::Training::loss)
      .def_readonly("batch", &Scene::Training::batch)
      .def_readwrite("intervals", &Scene::Training::intervals);
  py::class_<Scene::Field>(m, "Field")
      .def_readonly("steps", &Scene::Field::steps)
      .def_readonly("every", &Scene::Field::every)
      .def_readonly("smoothing", &Scene::Field::smoothing);
  py::class_<Scene::Compare>(m, "Compare")
      .def_readonly("seeds", &Scene::Compare::seeds)
      .def_readonly("constant", &Scene::Compare::constant)
      .def_readonly("growth", &Scene::Compare::growth)
      .def_readonly("schedule", &Scene::Compare::schedule)
      .def_readonly("rtol", &Scene::Compare::rtol)
      .def_readonly("target", &Scene::Compare::target);
}

}  // namespace

void bind_scenes(py::module_& m) {
  bind_tables(m);
  py::class_<Scene>(m, "Scene")
      .def_readonly("name", &Scene::name)
      .def_readonly("path", &Scene::path)
      .def_readonly("text", &Scene::text)
      .def_readonly("title", &Scene::title)
      .def_property_readonly("task",
                             [](const Scene& s) {
                               if (s.task == Scene::Task::kCorrector) return "corrector";
                               if (s.task == Scene::Task::kField) return "field";
                               return s.task == Scene::Task::kEmulator ? "emulator" : "parameters";
                             })
      .def_property_readonly("executions", &Scene::executions)
      .def_property_readonly("trains_network", &Scene::trains_network)
      .def_property_readonly("unit", [](const Scene& s) { return s.trains_network() ? "epoch" : "update"; })
      .def_readonly("dtype", &Scene::dtype)
      .def_property_readonly("device", [](const Scene& s) { return s.device; })
      .def("set_device", &Scene::set_device, py::arg("name"))
      .def("__copy__", [](const Scene& s) { return s; })
      .def_readonly("physics", &Scene::physics)
      .def_readonly("data", &Scene::data)
      .def_readonly("network", &Scene::network)
      .def_readonly("field", &Scene::field)
      .def_readonly("training", &Scene::training)
      .def_readonly("compare", &Scene::compare)
      .def_property_readonly("on_failure", [](const Scene& s) { return name(s.on_failure); })
      .def_property_readonly("method", [](const Scene& s) { return name(s.solver.method); })
      .def_property_readonly("max_iter", [](const Scene& s) { return s.solver.max_iter.expect_int(); })
      .def_property_readonly("rtol", [](const Scene& s) { return s.solver.rtol; })
      .def_property_readonly("preconditioner", [](const Scene& s) { return s.solver.preconditioner.spec().kind; })
      .def_property_readonly("restart", [](const Scene& s) { return s.solver.restart; })
      .def_property(
          "backward", [](const Scene& s) { return name(s.backward); }, &Scene::set_backward)
      .def_property_readonly("start", [](const Scene& s) { return name(s.start); })
      .def_property_readonly("prdp", [](const Scene& s) { return as_dict(s.prdp); })
      .def("learning_rate", &Scene::learning_rate, py::arg("update"));

  m.def("read_scene", &read_scene, py::arg("path"));
  m.def("scene_keys", [] {
    py::list keys;
    for (const auto& key : scene_keys())
      keys.append(py::dict(py::arg("table") = key.table, py::arg("name") = key.name, py::arg("value") = key.value,
                           py::arg("unit") = key.unit, py::arg("default") = key.otherwise, py::arg("when") = key.when,
                           py::arg("means") = key.means));
    return keys;
  });
  m.def(
      "find_device",
      [](const std::string& name) {
        const auto device = named_device(name);
        check_device(device);
        return device;
      },
      py::arg("name"), py::call_guard<py::gil_scoped_release>());
  m.def("parse_scene", &parse_scene, py::arg("text"), py::arg("path"));
  m.attr("MOST_COUNTED") = kMostCounted;
}
