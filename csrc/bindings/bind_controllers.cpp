#include "bindings.h"
#include "convert.h"
#include "prdp/controller/linear_schedule.h"
#include "prdp/controller/prdp_controller.h"
#include "prdp/controller/tolerance_controller.h"

namespace py = pybind11;
using namespace prdp;
using namespace py::literals;

namespace {

using Known = std::optional<double>;
/// A record of any controller: metric, smoothed, max_iter, refined, error, residual.
using Row = std::tuple<double, double, int64_t, bool, Known, Known>;

/// The rows from number `first` on: a loop that reads the last one in every call would else copy all of them.
std::vector<Row> rows_from(const Controller& controller, size_t first) {
  const auto& history = controller.state().history;
  std::vector<Row> rows;
  for (size_t i = first; i < history.size(); ++i) {
    const auto& r = history[i];
    rows.emplace_back(r.metric, r.smoothed, r.max_iter, r.refined, r.error, r.residual);
  }
  return rows;
}

void load(Controller& controller, int64_t max_iter, double checkpoint, const std::vector<Row>& rows) {
  Controller::State state{max_iter, checkpoint, {}};
  for (const auto& [metric, smoothed, k, refined, error, residual] : rows)
    state.history.push_back({metric, smoothed, k, refined, error, residual});
  controller.load_state(std::move(state));
}

/// What all of them have.
void bind_interface(py::module_& m) {
  py::class_<Controller>(m, "Controller")
      .def(
          "_step",
          [](Controller& c, double metric, bool converged, Known residual, Known error, double idle, double failed) {
            Solves solves{converged, residual, error};
            solves.idle = idle;
            solves.failed = failed;
            return c.step(metric, solves);
          },
          "metric"_a, "converged"_a, "residual"_a, "error"_a, "idle"_a, "failed"_a)
      .def("_load", &load, "max_iter"_a, "checkpoint"_a, "history"_a)
      .def_property_readonly("max_iter", &Controller::max_iter)
      .def_property_readonly("warning", &Controller::warning)
      .def_property_readonly("_budget",
                             [](const Controller& c) {
                               const auto b = c.budget();
                               return py::dict("max_iter"_a = b.max_iter, "adjoint_max_iter"_a = b.adjoint_max_iter,
                                               "rtol"_a = b.rtol, "adjoint_rtol"_a = b.adjoint_rtol);
                             })
      .def_property_readonly("_checkpoint", [](const Controller& c) { return c.state().checkpoint; })
      .def("_history_from", &rows_from, "first"_a);
}

py::dict as_dict(const ToleranceSettings& s) {
  return py::dict("ratio"_a = s.ratio, "adjoint_ratio"_a = s.adjoint_ratio, "floor"_a = s.floor,
                  "adjoint_floor"_a = s.adjoint_floor, "maximum"_a = s.maximum);
}

}  // namespace

void bind_controllers(py::module_& m) {
  m.attr("SMALL_RESIDUAL") = kSmallResidual;
  m.attr("PRDP_DEFAULTS") = as_dict(PRDPSettings{});
  m.attr("TOLERANCE_DEFAULTS") = as_dict(ToleranceSettings{});

  bind_interface(m);
  py::class_<PRDPController, Controller>(m, "PRDPController")
      .def(py::init([](double tau_step, double tau_stop, int64_t delta, int64_t window, int64_t initial,
                       int64_t increment, std::optional<int64_t> maximum, double growth, Known adjoint_ratio) {
             return PRDPController(
                 {tau_step, tau_stop, delta, window, initial, increment, maximum, growth, adjoint_ratio});
           }),
           py::kw_only(), "tau_step"_a, "tau_stop"_a, "delta"_a, "window"_a, "initial"_a, "increment"_a, "maximum"_a,
           "growth"_a, "adjoint_ratio"_a)
      .def_property_readonly("settings", [](const PRDPController& c) { return as_dict(c.settings()); });

  py::class_<ToleranceController, Controller>(m, "ToleranceController")
      .def(py::init([](double ratio, double adjoint_ratio, double floor, double adjoint_floor, int64_t maximum) {
             return ToleranceController({ratio, adjoint_ratio, floor, adjoint_floor, maximum});
           }),
           py::kw_only(), "ratio"_a, "adjoint_ratio"_a, "floor"_a, "adjoint_floor"_a, "maximum"_a)
      .def_property_readonly("rtol", &ToleranceController::rtol)
      .def_property_readonly("adjoint_rtol", &ToleranceController::adjoint_rtol)
      .def("_rtol_for", &ToleranceController::rtol_for, "smallest"_a)
      .def_property_readonly("settings", [](const ToleranceController& c) { return as_dict(c.settings()); });

  py::class_<LinearSchedule, Controller>(m, "LinearSchedule")
      .def(py::init<int64_t, int64_t, int64_t, Known>(), py::kw_only(), "initial"_a, "increment"_a, "maximum"_a,
           "adjoint_ratio"_a)
      .def_property_readonly("settings", [](const LinearSchedule& s) {
        return py::dict("initial"_a = s.initial(), "increment"_a = s.increment(), "maximum"_a = s.maximum(),
                        "adjoint_ratio"_a = s.adjoint_ratio());
      });
}
