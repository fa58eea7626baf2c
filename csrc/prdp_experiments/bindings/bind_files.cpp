#include <pybind11/stl/filesystem.h>

#include "prdp_experiments/bindings/bindings.h"
#include "prdp_experiments/files/checkpoint.h"
#include "prdp_experiments/files/seal.h"
#include "prdp_experiments/files/whole_files.h"

namespace py = pybind11;
using namespace prdp;

void bind_files(py::module_& m) {
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
}
