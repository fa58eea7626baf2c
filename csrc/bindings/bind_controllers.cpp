#include "bindings.h"
#include "prdp/controller/linear_schedule.h"
#include "prdp/controller/prdp_controller.h"

namespace py = pybind11;
using namespace prdp;

py::dict as_dict(const PRDPSettings& s) {
  using namespace py::literals;
  return py::dict("tau_step"_a = s.tau_step, "tau_stop"_a = s.tau_stop, "delta"_a = s.delta,
                  "window"_a = s.window, "initial"_a = s.initial, "increment"_a = s.increment,
                  "maximum"_a = s.maximum, "growth"_a = s.growth);
}

void bind_controllers(py::module_& m) {
  m.attr("PRDP_DEFAULTS") = as_dict(PRDPSettings{});
  py::class_<PRDPController>(m, "PRDPController")
      .def(py::init([](double tau_step, double tau_stop, int64_t delta, int64_t window, int64_t initial,
                       int64_t increment, std::optional<int64_t> maximum, double growth) {
             return PRDPController(
                 {tau_step, tau_stop, delta, window, initial, increment, maximum, growth});
           }),
           py::kw_only(), py::arg("tau_step"), py::arg("tau_stop"), py::arg("delta"), py::arg("window"),
           py::arg("initial"), py::arg("increment"), py::arg("maximum"), py::arg("growth"))
      .def("_step", &PRDPController::step, py::arg("metric"), py::arg("converged"))
      .def_property_readonly("max_iter", &PRDPController::max_iter)
      .def_property_readonly("settings",
                             [](const PRDPController& c) { return as_dict(c.settings()); })
      .def_property_readonly("_checkpoint",
                             [](const PRDPController& c) { return c.state().checkpoint; })
      .def_property_readonly("_history",
                             [](const PRDPController& c) {
                               std::vector<std::tuple<double, double, int64_t, bool>> rows;
                               for (const auto& r : c.state().history)
                                 rows.emplace_back(r.metric, r.smoothed, r.max_iter, r.refined);
                               return rows;
                             })
      .def("_load",
           [](PRDPController& c, int64_t max_iter, double checkpoint,
              const std::vector<std::tuple<double, double, int64_t, bool>>& history) {
             PRDPController::State state{max_iter, checkpoint, {}};
             for (const auto& [metric, smoothed, k, refined] : history)
               state.history.push_back({metric, smoothed, k, refined});
             c.load_state(std::move(state));
           },
           py::arg("max_iter"), py::arg("checkpoint"), py::arg("history"));

  py::class_<LinearSchedule>(m, "LinearSchedule")
      .def(py::init<int64_t, int64_t, int64_t>(), py::kw_only(), py::arg("initial"),
           py::arg("increment"), py::arg("maximum"))
      .def("_step", &LinearSchedule::step, py::arg("metric"), py::arg("converged"))
      .def_property_readonly("max_iter", &LinearSchedule::max_iter)
      .def_property_readonly("settings",
                             [](const LinearSchedule& s) {
                               using namespace py::literals;
                               return py::dict("initial"_a = s.initial(), "increment"_a = s.increment(),
                                               "maximum"_a = s.maximum());
                             })
      .def(
          "_load", [](LinearSchedule& s, int64_t max_iter) { s.load_state({max_iter}); },
          py::arg("max_iter"));
}
