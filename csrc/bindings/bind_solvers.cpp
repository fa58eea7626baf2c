#include <torch/csrc/Exceptions.h>

#include "bindings.h"
#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/detach_failed.h"
#include "prdp/gpu/fall_back.h"
#include "prdp/gpu/runtime.h"
#include "prdp/kernels/factor_cache.h"
#include "prdp/operators/function_operator.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/sum_over_axes.h"
#include "prdp/solvers/batch_loops.h"
#include "prdp/solvers/solve.h"
#include "prdp/solvers/warnings.h"
#include "prdp/steppers/idle_steps.h"
#include "prdp/steppers/stepper.h"
#include "prdp/threads/interruption.h"
#include "solves.h"

namespace py = pybind11;
using namespace prdp;

namespace {

OperatorSpec spec(std::string kind, std::vector<int64_t> shape, std::vector<double> parameters,
                  std::vector<at::Tensor> tensors) {
  return {std::move(kind), std::move(shape), std::move(parameters), std::move(tensors)};
}

/// A log that is closed with it, by no code of Python: an interruption cannot come between.
struct KeptLog {
  AdjointLog log = open_adjoint_log();
};

/// FailuresOfStep for Python's `with`.
class StepOfRollout {
 public:
  StepOfRollout(int64_t step, int64_t steps) : step_(step), steps_(steps) {}
  void enter() { here_.emplace(step_, steps_); }
  void exit() { here_.reset(); }

 private:
  int64_t step_, steps_;
  std::optional<FailuresOfStep> here_;
};

/// What the files of this package, of torch and of Python's own start begin with; a tuple that outlives the
/// interpreter.
py::tuple* not_of_user = nullptr;

/// The level of the innermost frame on Python's stack that is the user's; 1 where there is none.
int level_of_user() {
  try {
    int level = 1;
    auto frame = py::reinterpret_borrow<py::object>(reinterpret_cast<PyObject*>(PyEval_GetFrame()));
    for (; frame && !frame.is_none(); frame = frame.attr("f_back"), ++level)
      if (!frame.attr("f_code").attr("co_filename").attr("startswith")(*not_of_user).cast<bool>()) return level;
  } catch (const py::error_already_set&) {  // a name that is no text
  }
  return 1;
}

/// Python's warnings module, which names the user's line; a filter may turn the warning into an exception.
void warn_in_python(const std::string& text) {
  const py::gil_scoped_acquire gil;
  if (PyErr_WarnEx(PyExc_UserWarning, text.c_str(), level_of_user()) != 0) throw py::error_already_set();
}

/// A function of the user's in Python.
template <class Result>
struct PythonFunction {
  /// Destroyed with the interpreter's lock held.
  std::shared_ptr<py::object> function;

  explicit PythonFunction(py::object f)
      : function(new py::object(std::move(f)), [](py::object* held) {
          const py::gil_scoped_acquire gil;
          delete held;
        }) {}
  template <class... Args>
  Result operator()(const Args&... args) const {
    const py::gil_scoped_acquire gil;
    return (*function)(args...).template cast<Result>();
  }
};

template <class Function>
Function optional_function(const std::optional<py::function>& f) {
  return f ? Function(PythonFunction<typename Function::result_type>(*f)) : Function();
}

template <class Function>
PyObject* python_object(const Function& f) {
  const auto* in_python = f.template target<PythonFunction<typename Function::result_type>>();
  return in_python ? in_python->function->ptr() : nullptr;
}

/// Tells Python's garbage collector of the functions, so that it frees one that refers to its operator, such as
/// a method of the operator's owner. Those that a backward pass still needs are not the operator's alone.
int visit_products(PyObject* self, visitproc visit, void* arg) {
  Py_VISIT(Py_TYPE(self));
  if (!py::detail::is_holder_constructed(self)) return 0;
  const auto registered = py::cast<std::shared_ptr<RegisteredProducts>>(py::handle(self));
  if (registered.use_count() > 2) return 0;  // the holder's and this one
  const auto& products = registered->products();
  for (PyObject* function :
       {python_object(products.apply), python_object(products.apply_transpose), python_object(products.diagonal),
        python_object(products.transpose_in_transforms), python_object(products.product_rule)})
    Py_VISIT(function);
  return 0;
}

void collect_products(PyHeapTypeObject* heap_type) {
  heap_type->ht_type.tp_flags |= Py_TPFLAGS_HAVE_GC;
  heap_type->ht_type.tp_traverse = visit_products;
}

unsigned long main_thread = 0;

/// Runs the handlers of signals, which Python does on its main thread alone; Ctrl-C's raises KeyboardInterrupt.
void check_signals() {
  if (PyThread_get_thread_ident() != main_thread) return;
  const py::gil_scoped_acquire gil;
  if (PyErr_CheckSignals() != 0) throw py::error_already_set();
}

void bind_operators(py::module_& m) {
  py::class_<FunctionCode, std::shared_ptr<FunctionCode>>(m, "FunctionCode").def(py::init<>());
  py::class_<RegisteredProducts, std::shared_ptr<RegisteredProducts>>(m, "RegisteredProducts",
                                                                      py::custom_type_setup(collect_products))
      .def(py::init([](py::function apply, std::optional<py::function> apply_transpose,
                       std::optional<py::function> diagonal, py::function transpose_in_transforms,
                       py::function product_rule, std::shared_ptr<FunctionCode> code) {
             auto made = RegisteredProducts::make(
                 {PythonFunction<at::Tensor>(apply), optional_function<Products::Product>(apply_transpose),
                  optional_function<Products::Diagonal>(diagonal), PythonFunction<at::Tensor>(transpose_in_transforms),
                  PythonFunction<std::vector<at::Tensor>>(product_rule)});
             auto products = std::const_pointer_cast<RegisteredProducts>(made);
             products->code = std::move(code);
             return products;
           }),
           py::arg("apply"), py::arg("apply_transpose"), py::arg("diagonal"), py::arg("transpose_in_transforms"),
           py::arg("product_rule"), py::arg("code"))
      .def_property_readonly("number", &RegisteredProducts::number);
  m.def("batched_axes", &batched_axes, py::arg("kind"), py::arg("axes"), py::arg("tensors"),
        "The number of axes of each of so many tensors of an operator where it has one for the batch, on a grid of so "
        "many axes: 0 if all samples share it. None if that is not known.");
  m.def(
      "check_operator",
      [](std::string kind, std::vector<int64_t> shape, std::vector<double> parameters,
         std::vector<at::Tensor> tensors) {
        // What a sample has for itself is judged by a solve, which knows what a failure means.
        const bool kernels_check = std::any_of(tensors.begin(), tensors.end(),
                                               [](const at::Tensor& t) { return gpu::runtime_of(t.device()); });
        HANDLE_TH_ERRORS  // hands warnings to Python's
            make_operator(spec(kind, shape, parameters, tensors))
                ->check_parameters(kernels_check ? Checks::kHost : Checks::kShared);
        END_HANDLE_TH_ERRORS_PYBIND
      },
      py::arg("kind"), py::arg("shape"), py::arg("parameters"), py::arg("tensors"));
  m.def(
      "product_rule",
      [](const at::Tensor& lambda, const at::Tensor& v, std::vector<at::Tensor> tensors, std::string kind,
         std::vector<int64_t> shape, std::vector<double> parameters) {
        return make_operator(spec(kind, shape, parameters, tensors))->product_rule(lambda, v);
      },
      "∂⟨lambda, A v⟩ with respect to each tensor of A, as the solves take it; None where there is none.",
      py::call_guard<py::gil_scoped_release>(), py::arg("lambda_"), py::arg("v"), py::arg("tensors"), py::arg("kind"),
      py::arg("shape"), py::arg("parameters"));

  m.def(
      "is_sum_over_axes",
      [](const at::Tensor& b, std::vector<at::Tensor> tensors, std::string kind, std::vector<int64_t> shape,
         std::vector<double> parameters) {
        return is_sum_over_axes(*make_operator(spec(kind, shape, parameters, tensors)), b);
      },
      "Whether `Direct` solves with A, axis by axis, without a factorisation of the whole.",
      py::call_guard<py::gil_scoped_release>(), py::arg("b"), py::arg("tensors"), py::arg("kind"), py::arg("shape"),
      py::arg("parameters"));
}

void bind_reports(py::module_& m) {
  py::class_<KeptLog>(m, "AdjointLog").def(py::init<>()).def_property_readonly("number", [](const KeptLog& kept) {
    return *kept.log;
  });
  m.def(
      "read_adjoint_log",
      [](int64_t log) -> std::optional<py::tuple> {
        const auto info = adjoint_log::read(log);
        if (!info) return std::nullopt;
        return as_tuple(*info);
      },
      py::arg("log"));
  m.def(
      "join_adjoint_logs",
      [](const std::vector<int64_t>& logs) -> std::optional<py::tuple> {
        const auto info = join_adjoint_logs(logs);
        if (!info) return std::nullopt;
        return as_tuple(*info);
      },
      py::arg("logs"));
  py::class_<StepOfRollout>(m, "StepOfRollout")
      .def(py::init<int64_t, int64_t>(), py::arg("step"), py::arg("steps"))
      .def("__enter__", &StepOfRollout::enter)
      .def("__exit__", [](StepOfRollout& self, const py::args&) { self.exit(); });
}

}  // namespace

void bind_solvers(py::module_& m) {
  const auto files_of = [](const char* package) {
    return py::module_::import("os.path").attr("join")(py::module_::import(package).attr("__path__")[py::int_(0)], "");
  };
  not_of_user = new py::tuple(py::make_tuple(files_of("prdp_torch"), files_of("torch"), "<frozen "));
  set_warning_sink(warn_in_python);
  m.def("warn", warn_in_python, "Warn, at the line of the user's that led here.", py::arg("text"));
  main_thread = py::module_::import("threading").attr("main_thread")().attr("ident").cast<unsigned long>();
  interruption::set_check(check_signals);
  m.attr("DEFAULT_RTOL") = kDefaultRtol;
  m.attr("DEFAULT_RESTART") = kDefaultRestart;
  m.attr("CHECKPOINT_SQRT") = kCheckpointSqrt;
  py::dict statuses;
  for (const auto& s : solve_statuses()) statuses[s.name] = static_cast<int64_t>(s.status);
  m.attr("SOLVE_STATUSES") = statuses;
  bind_operators(m);
  bind_reports(m);

  m.def(
      "warn_of_idle_steps",
      [](const at::Tensor& iterations, const at::Tensor& residual, const at::Tensor& status, double rtol,
         bool has_controller, const std::string& on_failure) {
        const SolveInfo info{iterations, residual, status, iterations, residual};
        warn_of_idle_steps(info, rtol, has_controller, on_failure_from_name(on_failure));
      },
      py::arg("iterations"), py::arg("residual"), py::arg("status"), py::arg("rtol"), py::arg("has_controller"),
      py::arg("on_failure"), "Warn where the steps of a rollout, (batch, steps), hand their start on.");
  m.def("check_start", [](const std::string& start) { start_from_name(start); }, py::arg("start"));
  m.def("way_of_last_solve", &way_of_last_solve,
        "How this thread's last solve was computed: kernel, loops or tensors.");
  m.def("kernels_made", &gpu::kernels_made, "The kernels of GPUs that this process has made, by name.");
  m.def("any_nonfinite", &any_nonfinite, py::arg("status"), "Whether a sample was refused for a NaN or Inf in b or A.");
  m.def(
      "block_gradients_of_failed",
      [](const at::Tensor& u, const at::Tensor& status, const std::string& on_failure) {
        block_gradients_of_failed(u, status, on_failure_from_name(on_failure));
      },
      py::arg("u"), py::arg("status"), py::arg("on_failure"),
      "No gradient passes through a state u from here on, for samples whose solve has none.");
  m.def("count_factorisations", &factor_cache::count_made, "How many sparse factorisations were made so far.");
  m.def("bytes_of_factorisations", &factor_cache::bytes_kept, "The memory of those that are kept for later solves.");
  m.def("clear_factorisations", &factor_cache::clear, "Frees those that are kept for later solves.");
  m.def(
      "solve_with_tensors",
      [](const at::Tensor& b, std::vector<at::Tensor> tensors, std::string kind, std::vector<int64_t> shape,
         std::vector<double> parameters, bool transposed, std::string solver, int64_t max_iter, double rtol,
         int64_t restart, std::optional<at::Tensor> x0, std::string preconditioner) {
        auto a = spec(kind, shape, parameters, tensors);
        a.transposed = transposed;
        const auto result = [&] {
          const py::gil_scoped_release no_gil;
          const batch_loops::Off no_loops;
          return solve_with_tensors(*make_operator(a), b,
                                    {.solver = {method_from_name(solver), max_iter, rtol, restart,
                                                OperatorSpec{std::move(preconditioner), {}, {}, {}}},
                                     .x0 = x0.value_or(at::Tensor())});
        }();
        return py::make_tuple(result.u, as_tuple(result.info));
      },
      "The plain-tensor solver behind linear_solve, without derivatives: the oracle of the CPU loops.", py::arg("b"),
      py::arg("tensors"), py::arg("kind"), py::arg("shape"), py::arg("parameters"), py::arg("transposed"),
      py::arg("solver"), py::arg("max_iter"), py::arg("rtol"), py::arg("restart") = kDefaultRestart,
      py::arg("x0") = py::none(), py::arg("preconditioner") = "");
}
