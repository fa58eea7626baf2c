#include <pybind11/functional.h>
#include <pybind11/stl/filesystem.h>

#include "bindings.h"
#include "prdp/operators/navier_stokes_operator.h"
#include "prdp/scenes/checkpoint.h"
#include "prdp/scenes/data.h"
#include "prdp/scenes/failures.h"
#include "prdp/scenes/field_problem.h"
#include "prdp/scenes/files.h"
#include "prdp/scenes/fresh_data.h"
#include "prdp/scenes/loss.h"
#include "prdp/scenes/scene.h"
#include "prdp/scenes/seal.h"
#include "prdp/scenes/sentence.h"

namespace py = pybind11;
using namespace prdp;

void bind_scenes(py::module_& m) {
  py::class_<Scene::Physics>(m, "Physics")
      .def_readonly("equation", &Scene::Physics::equation)
      .def_readonly("shape", &Scene::Physics::shape)
      .def_readonly("nu", &Scene::Physics::nu)
      .def_readonly("dt", &Scene::Physics::dt)
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
      .def_readonly("valid_steps", &Scene::Data::valid_steps)
      .def_readonly("valid_max_iter", &Scene::Data::valid_max_iter)
      .def_readonly("reference_shape", &Scene::Data::reference_shape);
  py::class_<Scene::Network>(m, "Network")
      .def_readonly("kind", &Scene::Network::kind)
      .def_readonly("hidden", &Scene::Network::hidden)
      .def_readonly("blocks", &Scene::Network::blocks)
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
  m.def("parse_scene", &parse_scene, py::arg("text"), py::arg("path"));

  py::class_<Dataset>(m, "Dataset")
      .def_readonly("train_start", &Dataset::train_start)
      .def_readonly("train_first", &Dataset::train_first)
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
      [](const at::Tensor& kappa, double dt) {
        const auto stencil = diffusion_stencil(kappa, dt);
        return std::make_pair(stencil.coefficients, stencil.offsets);
      },
      py::arg("kappa"), py::arg("dt"));
  m.def("observed", &observed, py::arg("states"), py::arg("scene"));
  m.def("roughness", &roughness, py::arg("theta"));

  py::class_<Checkpoint>(m, "Checkpoint")
      .def(py::init<std::filesystem::path, std::string>(), py::arg("path"), py::arg("settings"))
      .def("due", &Checkpoint::due)
      .def(
          "write", [](Checkpoint& c, std::string state) { c.write(std::move(state)); }, py::arg("state"))
      .def("read",
           [](Checkpoint& c) {
             const auto state = c.read();
             return state ? std::optional<py::bytes>(*state) : std::nullopt;
           })
      .def("read_before", [](Checkpoint& c) { return py::bytes(c.read_before()); })
      .def_property_readonly("notice", &Checkpoint::notice)
      .def("refuse", &Checkpoint::refuse)
      .def("remove_before", &Checkpoint::remove_before, py::arg("record"))
      .def("check_length", &Checkpoint::check_length, py::arg("done"), py::arg("intervals"))
      .def("remove", &Checkpoint::remove);

  m.attr("MOST_COUNTED") = kMostCounted;
  m.def("sentence", &sentence, py::arg("what"));
  m.def("fingerprint", &fingerprint, py::arg("content"));
  m.def("seal_record", &seal_record, py::arg("object"));
  m.def("read_record", &read_record, py::arg("path"));
  m.def("refuse_finished", &refuse_finished, py::arg("record"), py::arg("intervals"), py::arg("wanted"));
  m.def(
      "write_whole",
      [](const std::vector<std::pair<std::filesystem::path, std::string>>& files) {
        std::vector<NewFile> all;
        for (const auto& [path, content] : files) all.push_back({path, content});
        write_whole(all);
      },
      py::arg("files"));
  py::class_<FolderLock>(m, "FolderLock")
      .def(py::init<const std::filesystem::path&>(), py::arg("folder"))
      .def("release", &FolderLock::release);

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
}
