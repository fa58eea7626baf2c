#include <pybind11/functional.h>
#include <pybind11/stl/filesystem.h>

#include "prdp_experiments/bindings/bindings.h"
#include "prdp_experiments/files/checkpoint.h"
#include "prdp_experiments/files/record.h"
#include "prdp_experiments/files/seal.h"
#include "prdp_experiments/files/whole_files.h"
#include "prdp_experiments/training/progress.h"

namespace py = pybind11;
using namespace prdp;
using namespace py::literals;

namespace {

/// A record of a controller: metric, smoothed, max_iter, refined, error, residual.
using Row = std::tuple<double, double, int64_t, bool, std::optional<double>, std::optional<double>>;
/// One of the files of a checkpoint: path, state, what is wrong with it.
using Found = std::tuple<std::filesystem::path, py::bytes, std::string>;

py::bytes pack_state(TensorMap tensors, const py::dict& curves, int64_t max_iter, double checkpoint,
                     const std::vector<Row>& history) {
  train::Curves values;
  train::each_curve(
      values, [&]<class T>(const char* name, std::vector<T>& curve) { curve = curves[name].cast<std::vector<T>>(); });
  Controller::State state{max_iter, checkpoint, {}};
  for (const auto& [metric, smoothed, k, refined, error, residual] : history)
    state.history.push_back({metric, smoothed, k, refined, error, residual});
  train::save(tensors, values, state);
  return pack(tensors);
}

/// The curves, and the state of the controller as its load_state_dict() takes it.
std::pair<py::dict, py::dict> progress(Saved& saved, int64_t updates_per_interval) {
  const auto found = train::load_progress(saved, updates_per_interval);
  py::dict curves;
  train::each_curve(found.curves, [&](const char* name, const auto& values) { curves[name] = values; });
  std::vector<Row> rows;
  for (const auto& r : found.controller.history)
    rows.emplace_back(r.metric, r.smoothed, r.max_iter, r.refined, r.error, r.residual);
  return {curves, py::dict("max_iter"_a = found.controller.max_iter, "checkpoint"_a = found.controller.checkpoint,
                           "history"_a = rows)};
}

bool restore(Checkpoint& checkpoint, const std::vector<Found>& found, const py::function& load) {
  std::vector<Checkpoint::Found> files;
  for (const auto& [path, state, wrong] : found) files.push_back({path, state, wrong});
  return checkpoint.restore(files, [&](Saved& saved) {
    try {
      load(py::cast(&saved, py::return_value_policy::reference));
    } catch (py::error_already_set& error) {
      if (!error.matches(PyExc_ValueError)) throw;
      TORCH_CHECK_VALUE(false, py::str(error.value()).cast<std::string>());
    }
  });
}

void bind_saved(py::module_& m) {
  py::class_<Saved>(m, "Saved", "The named tensors of a file, each of which is asked for and checked.")
      .def(py::init([](const std::string& content) { return Saved(unpack(content)); }), py::arg("content"))
      .def("has", &Saved::has, py::arg("name"))
      .def(
          "take",
          [](Saved& saved, const std::string& name, const at::Tensor& like, std::optional<double> least,
             std::optional<double> most, bool finite) {
            Range range;
            range.least = least.value_or(range.least);
            range.most = most.value_or(range.most);
            range.finite = finite;
            return saved.take(name, like.scalar_type(), like.sizes(), range);
          },
          py::arg("name"), py::arg("like"), py::arg("least") = py::none(), py::arg("most") = py::none(),
          py::arg("finite") = true)
      .def("restore", &Saved::restore, py::arg("name"), py::arg("generator"))
      .def("progress", &progress, py::arg("updates_per_interval"))
      .def("finish", &Saved::finish);
  m.def("pack_state", &pack_state, py::arg("tensors"), py::arg("curves"), py::arg("max_iter"), py::arg("checkpoint"),
        py::arg("history"));
}

}  // namespace

void bind_files(py::module_& m) {
  bind_saved(m);
  py::class_<Checkpoint>(m, "Checkpoint")
      .def(py::init<std::filesystem::path, std::string>(), py::arg("path"), py::arg("settings"))
      .def("due", &Checkpoint::due)
      .def(
          "write", [](Checkpoint& c, std::string state) { c.write(std::move(state)); }, py::arg("state"))
      .def("find",
           [](Checkpoint& c) {
             std::vector<Found> files;
             for (const auto& [path, state, wrong] : c.find()) files.emplace_back(path, py::bytes(state), wrong);
             return files;
           })
      .def("restore", &restore, py::arg("found"), py::arg("load"))
      .def_property_readonly("notice", &Checkpoint::notice)
      .def("remove_before", &Checkpoint::remove_before, py::arg("record"))
      .def("refuse_to_lose", &Checkpoint::refuse_to_lose, py::arg("record"))
      .def("check_length", &Checkpoint::check_length, py::arg("done"), py::arg("intervals"))
      .def("remove", &Checkpoint::remove);

  m.def("fingerprint", &fingerprint, py::arg("content"));
  m.def("seal_record", &seal_record, py::arg("object"));
  m.def("read_record", &read_record, py::arg("path"));
  m.def(
      "read_training",
      [](const std::filesystem::path& path) -> std::optional<std::string> {
        const auto record = read_training(path);
        return record ? std::optional(record->dump()) : std::nullopt;
      },
      py::arg("path"));
  m.def("write_training", &write_training, py::arg("path"), py::arg("object"), py::arg("weights"));
  m.def("settle_weights", &settle_weights, py::arg("path"));
  m.def(
      "read_weights",
      [](const std::filesystem::path& path, const std::string& wanted) -> std::optional<py::bytes> {
        const auto content = read_weights(path, wanted);
        return content ? std::optional(py::bytes(*content)) : std::nullopt;
      },
      py::arg("path"), py::arg("fingerprint"));
  m.def("refuse_finished", &refuse_finished, py::arg("record"), py::arg("intervals"), py::arg("wanted"));
  m.def(
      "write_whole", [](const std::filesystem::path& path, std::string_view content) { write_whole({path, content}); },
      py::arg("path"), py::arg("content"));
  py::class_<FolderLock>(m, "FolderLock")
      .def(py::init<const std::filesystem::path&>(), py::arg("folder"))
      .def("release", &FolderLock::release);
}
