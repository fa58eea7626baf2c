#include <ATen/PythonTorchFunctionTLS.h>
#include <torch/csrc/autograd/python_variable.h>

#include "bindings.h"
#include "prdp/autograd/packed_options.h"
#include "prdp/operators/function_checks.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/registered_products.h"
#include "prdp/solvers/memory_check.h"
#include "prdp/steppers/equation.h"
#include "solves.h"

/// The ops step and linear_solve past torch's dispatcher, which costs more than a small solve. None where somebody
/// watches; then the op is to be called.
namespace py = pybind11;
using namespace prdp;

namespace {

/// Whether Python keeps out of calls with this tensor: a subclass may have a __torch_function__.
bool is_exact(py::handle t) { return THPVariable_CheckExact(t.ptr()); }

bool nobody_in_python_watches(const py::object& b, const std::vector<py::object>& tensors) {
  return no_mode_but_a_profiler_is_on() && !at::impl::torch_function_mode_enabled() && is_exact(b) &&
         std::all_of(tensors.begin(), tensors.end(), is_exact);
}

std::vector<at::Tensor> unwrapped(const std::vector<py::object>& tensors) {
  std::vector<at::Tensor> found;
  for (const auto& t : tensors) found.push_back(THPVariable_Unpack(t.ptr()));
  return found;
}

/// The options as ops take them, packed into lists.
SolveOptions unpack_lists(const std::vector<std::string>& names, const std::vector<int64_t>& counts,
                          const std::vector<double>& numbers, const std::vector<at::Tensor>& preconditioner) {
  return unpack(c10::List<std::string>(names), std::vector<c10::SymInt>(counts.begin(), counts.end()), numbers,
                preconditioner);
}

template <class Solve>
py::tuple without_lock(const Solve& solve) {
  return as_tuple([&] {
    const py::gil_scoped_release no_gil;
    return solve();
  }());
}

py::object call_step(const py::object& u, const std::vector<py::object>& tensors, const Equation& equation,
                     const SolveOptions& options, int64_t max_iter, int64_t adjoint_log) {
  HANDLE_TH_ERRORS
  if (!nobody_in_python_watches(u, tensors)) return py::none();
  auto whole = equation;
  whole.tensors = unwrapped(tensors);
  return without_lock([&, state = THPVariable_Unpack(u.ptr())] {
    RECORD_FUNCTION("prdp::step", c10::ArrayRef<const c10::IValue>());  // as the dispatcher does
    return step(whole, state, with(options, max_iter, adjoint_log));
  });
  END_HANDLE_TH_ERRORS_PYBIND
}

py::object call_linear_solve(const py::object& b, const std::vector<py::object>& tensors, std::string kind,
                             std::vector<int64_t> shape, std::vector<double> parameters, const SolveOptions& options,
                             int64_t max_iter, int64_t adjoint_log, const std::optional<py::object>& x0) {
  HANDLE_TH_ERRORS
  const bool is_watched = !nobody_in_python_watches(b, tensors) || (x0 && !is_exact(*x0));
  const OperatorSpec a{std::move(kind), std::move(shape), std::move(parameters), unwrapped(tensors)};
  const auto rhs = THPVariable_Unpack(b.ptr());
  if (is_watched && is_function(a) && in_vmap()) refuse_mapped_captures(a, rhs);  // as linear_solve() does
  if (is_watched) return py::none();
  return without_lock([&, start = x0 ? THPVariable_Unpack(x0->ptr()) : at::Tensor()] {
    return linear_solve(a, rhs, with(options, max_iter, adjoint_log), start);
  });
  END_HANDLE_TH_ERRORS_PYBIND
}

}  // namespace

void bind_steps(py::module_& m) {
  py::class_<SolveOptions>(m, "SolveOptions", "The options of a solve but for max_iter and the log.")
      .def(py::init(&unpack_lists), py::arg("names"), py::arg("counts"), py::arg("numbers"), py::arg("preconditioner"))
      .def(
          "check", [](const SolveOptions& options, const std::string& who) { options.check(who.c_str()); },
          py::arg("who"));
  py::class_<Equation>(m, "Equation", "An equation but for its tensors.")
      .def(py::init(
          [](std::string kind, std::vector<int64_t> shape, std::vector<double> parameters, int64_t picard_steps) {
            return Equation{std::move(kind), std::move(shape), std::move(parameters), {}, picard_steps};
          }));
  m.def("physical_memory", &physical_memory);
  m.def("step", &call_step, py::arg("u"), py::arg("tensors"), py::arg("equation"), py::arg("options"),
        py::arg("max_iter"), py::arg("adjoint_log"));
  m.def("linear_solve", &call_linear_solve, py::arg("b"), py::arg("tensors"), py::arg("kind"), py::arg("shape"),
        py::arg("parameters"), py::arg("options"), py::arg("max_iter"), py::arg("adjoint_log"), py::arg("x0"));
}
