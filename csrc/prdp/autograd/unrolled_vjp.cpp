#include "prdp/autograd/unrolled_vjp.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/autograd.h>
#include <torch/library.h>

#include <limits>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/finite_rows.h"
#include "prdp/autograd/flat_options.h"
#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/solve.h"

namespace prdp {

namespace {

constexpr const char* kSchema =
    "unrolled_vjp(Tensor cotangent, Tensor b, Tensor iterations, Tensor status, Tensor residual, "
    "int[] needed, Tensor[] tensors, str kind, int[] shape, float[] parameters, bool "
    "transposed, " PRDP_OPTIONS_SCHEMA PRDP_X0_SCHEMA
    ") -> (Tensor[] gradients, Tensor iterations, Tensor residual, Tensor status, "
    "Tensor operator_applications, Tensor floor)";
using Outputs = std::tuple<std::vector<at::Tensor>, at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor>;
using Signature = WithOptionsAndX0<Outputs(const at::Tensor&, const at::Tensor&, const at::Tensor&, const at::Tensor&,
                                           const at::Tensor&, at::IntArrayRef, at::TensorList, c10::string_view,
                                           at::IntArrayRef, at::ArrayRef<double>, bool)>;

/// Residuals up to so many units of rounding are rounding.
constexpr double kRoundings = 8.0;

/// One number per sample, on the host.
template <class T>
std::vector<T> to_host(const at::Tensor& t, int64_t batch) {
  const auto flat =
      t.detach().to(at::kCPU, c10::CppTypeToScalarType<T>::value).reshape({-1}).expand({batch}).contiguous();
  return {flat.template const_data_ptr<T>(), flat.template const_data_ptr<T>() + batch};
}

/// ‖u‖/‖b‖ of each sample, whatever their order of magnitude.
std::vector<double> growth(const at::Tensor& u, const at::Tensor& b) {
  const auto norm = [](const at::Tensor& t) {
    const auto rows = t.detach().to(at::kDouble).flatten(1);
    const auto largest = rows.abs().amax(1, /*keepdim=*/true);
    return std::pair((rows / largest).norm(2, 1), largest.squeeze(1));
  };
  const auto [u_norm, u_largest] = norm(u);
  const auto [b_norm, b_largest] = norm(b);
  return to_host<double>(u_norm / b_norm * (u_largest / b_largest), b.size(0));
}

/// Those of the candidates whose residual is no more than the rounding errors of computing it, and less than √ε; where
/// one may be, u is asked for.
template <class MakeU>
Rows within_rounding(const Operator& a, const Solved& solved, const Rows& candidates, const MakeU& make_u) {
  const int64_t batch = solved.b.size(0);
  const double epsilon = epsilon_of(solved.b);
  const auto residual = to_host<double>(solved.residual, batch);
  const auto status = to_host<int64_t>(solved.status, batch);
  Rows rows(batch, false), near(batch, false);
  for (int64_t i = 0; i < batch; ++i) {
    const auto s = static_cast<SolveStatus>(status[i]);
    if (!candidates[i] || is_refused(s)) continue;
    rows[i] = s == SolveStatus::kConvergedBreakdown || residual[i] == 0.0;
    near[i] = !rows[i] && residual[i] <= std::sqrt(epsilon);
  }
  if (!any(near)) return rows;
  const auto norm = to_host<double>(a.norm(), batch), u_over_b = growth(make_u(), solved.b);
  for (int64_t i = 0; i < batch; ++i)
    rows[i] = rows[i] || (near[i] && residual[i] <= kRoundings * epsilon / 2 * (norm[i] * u_over_b[i] + 1.0));
  return rows;
}

/// The samples that were solved to rounding, but those whose iterations are smooth there: all of a polynomial
/// up to max_iter, and as many of CG as there are unknowns, where none before the last sufficed.
template <class MakeU>
Rows solved_to_rounding(const Operator& a, const Solved& solved, const Solver& solver, const MakeU& make_u) {
  const int64_t batch = solved.b.size(0);
  const auto iterations = to_host<int64_t>(solved.iterations, batch);
  Rows candidates(batch, true);
  if (traits(solver.method).is_polynomial)
    for (int64_t i = 0; i < batch; ++i) candidates[i] = iterations[i] != solver.max_iter.expect_int();
  auto rows = within_rounding(a, solved, candidates, make_u);
  if (!any(rows)) return rows;
  const int64_t unknowns = solved.b.numel() / batch;
  if (traits(solver.method).ends_at_unknowns &&
      std::find(iterations.begin(), iterations.end(), unknowns) != iterations.end()) {
    auto shorter = solver;
    shorter.max_iter = unknowns - 1;
    shorter.rtol = 0.0;
    const auto one_less = solve(a, solved.b.detach(), {shorter, {}, true, solved.x0});
    const Solved before{solved.b, one_less.u, {}, one_less.info.status, one_less.info.residual};
    const auto sufficed = within_rounding(a, before, rows, [&] { return one_less.u; });
    for (int64_t i = 0; i < batch; ++i) rows[i] = rows[i] && (iterations[i] != unknowns || sufficed[i]);
  }
  return rows;
}

/// ‖ū - Aᵀ b̄‖ / ‖ū‖ of each sample, within the range of Aᵀ, where A is singular; 0 where ū is.
std::vector<double> adjoint_residuals(const Operator& a, const at::Tensor& cotangent, const at::Tensor& b_bar) {
  const at::NoGradGuard no_grad;
  const auto norm = [](const at::Tensor& v) {
    return to_host<double>(v.flatten(1).to(at::kDouble).norm(2, 1), v.size(0));
  };
  const auto product = apply_on_loops(a, b_bar.detach().contiguous(), /*transposed=*/true);
  const auto left = norm(a.project_solution(cotangent.detach() - product)), whole = norm(cotangent.detach());
  std::vector<double> residuals(whole.size());
  for (size_t i = 0; i < whole.size(); ++i) residuals[i] = whole[i] > 0.0 ? left[i] / whole[i] : 0.0;
  return residuals;
}

/// Takes the derivative of each sample in its way (unrolled_vjp.h); `of_iterations` is that of the last.
using OfIterations = UnrolledVjp (*)(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                                     at::IntArrayRef needed);

SolveVjp vjp_of_samples(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& spec,
                        const SolveOptions& options, at::IntArrayRef needed, OfIterations of_iterations,
                        decltype(linear_solve)& any_solve) {
  const int64_t batch = solved.b.size(0);
  const auto a = make_operator(spec);
  at::Tensor u;  // again, as it is not kept
  const auto make_u = [&] {
    auto silent = options;
    silent.on_failure = OnFailure::kReturn;
    silent.adjoint_log = 0;
    if (!u.defined()) u = any_solve(spec, solved.b, silent, solved.x0).u;
    return u;
  };
  auto exact = solved_to_rounding(*a, solved, options.solver, make_u);
  const auto sound = finite_rows(cotangent);
  const bool for_a = std::find(needed.begin() + 1, needed.end(), 1) != needed.end();
  const auto bar = only(cotangent, sound);
  const auto counts = to_host<int64_t>(solved.iterations, batch), status = to_host<int64_t>(solved.status, batch);

  Rows lost(batch, false);  // carry no gradient
  if (options.on_failure == OnFailure::kZeroGrad)
    for (int64_t i = 0; i < batch; ++i) lost[i] = is_failure(static_cast<SolveStatus>(status[i]));

  auto implicit = options;
  implicit.backward = Backward::kImplicit;
  implicit.checkpoint_every = implicit.adjoint_log = 0;
  implicit.on_failure = OnFailure::kReturn;  // judged below, by the tolerance that was asked for
  const double asked = options.adjoint_rtol.value_or(options.solver.rtol);
  implicit.adjoint_rtol = std::min(asked, kRoundings / 2 * epsilon_of(solved.b));

  SolveInfo info{at::empty({batch}, at::kLong), at::empty({batch}, at::kDouble), at::empty({batch}, at::kLong),
                 at::empty({batch}, at::kLong), at::zeros({batch}, at::kDouble)};
  const auto says = [&](int64_t i, int64_t iterations, double residual, SolveStatus why, int64_t applications) {
    info.iterations.mutable_data_ptr<int64_t>()[i] = iterations;
    info.residual.mutable_data_ptr<double>()[i] = residual;
    info.status.mutable_data_ptr<int64_t>()[i] = static_cast<int64_t>(why);
    info.operator_applications.mutable_data_ptr<int64_t>()[i] = applications;
  };
  const auto share = [&](const Rows& rows) {
    std::vector<at::Tensor> sum(needed.size());
    auto caps = at::zeros({batch}, at::kLong);
    const bool of_none = !any(rows);  // what the iterations make of no cotangent, finite or not
    for (int64_t i = 0; i < batch; ++i)
      if ((rows[i] || of_none) && !exact[i] && !lost[i]) caps.mutable_data_ptr<int64_t>()[i] = counts[i];
    std::vector<int64_t> applications(batch, 0);
    if (caps.any().item<bool>()) {
      auto found = of_iterations(
          only(bar, rows), solved.b,
          {spec, solved.x0, options.solver, caps.to(solved.iterations.device()), options.checkpoint_every}, needed);
      sum = std::move(found.gradients);
      applications = to_host<int64_t>(found.operator_applications, batch);
    }
    for (int64_t i = 0; i < batch; ++i)
      says(i, counts[i], std::numeric_limits<double>::quiet_NaN(), static_cast<SolveStatus>(status[i]),
           applications[i]);
    const auto some = both(rows, exact);
    if (any(some)) {
      const auto for_products = for_a ? make_u() : at::Tensor();
      const auto found = implicit_vjp(only(bar, some), for_products, spec, implicit, needed, any_solve);
      for (size_t i = 0; i < sum.size(); ++i) add_to(sum[i], found.gradients[i]);
      const auto iterations = to_host<int64_t>(found.info.iterations, batch);
      const auto residual = to_host<double>(found.info.residual, batch);
      const auto statuses = to_host<int64_t>(found.info.status, batch);
      const auto products = to_host<int64_t>(found.info.operator_applications, batch);
      for (int64_t i = 0; i < batch; ++i) {
        if (!some[i]) continue;
        const auto found_status = static_cast<SolveStatus>(statuses[i]);
        const bool good = statuses[i] < 0 && !is_refused(found_status) && residual[i] <= asked;
        says(i, iterations[i], residual[i], good ? SolveStatus::kConverged : found_status, products[i]);
      }
    }
    return sum;
  };
  auto rows = sound;
  SolveVjp found{finite_sum(rows, share), {}};
  if (found.gradients[0].defined() && !traits(options.solver.method).is_polynomial) {
    const auto residual = adjoint_residuals(*a, bar, found.gradients[0]);
    bool any_far = false;
    for (int64_t i = 0; i < batch; ++i) {
      const auto s = static_cast<SolveStatus>(status[i]);
      const bool ended = s == SolveStatus::kConverged || s == SolveStatus::kStagnated;
      if (!ended || exact[i] || !rows[i] || lost[i]) continue;
      any_far = any_far || residual[i] > 1.0;
      exact[i] = residual[i] > 1.0;
    }
    if (any_far) found.gradients = finite_sum(rows, share);
  }
  if (options.on_failure == OnFailure::kZeroGrad) {
    auto good = rows;
    for (int64_t i = 0; i < batch; ++i)
      if (exact[i] && is_failure(static_cast<SolveStatus>(info.status.const_data_ptr<int64_t>()[i]))) good[i] = false;
    if (good != rows) {  // their adjoint solve failed
      auto said = info;
      for (auto* part : said.parts()) *part = part->clone();
      found.gradients = finite_sum(good, share);
      info = said;
    }
  }
  for (size_t i = 0; i < needed.size(); ++i)
    if (needed[i] && !found.gradients[i].defined())
      found.gradients[i] = i == 0 ? only(cotangent, Rows(batch, false)) : at::zeros_like(spec.tensors[i - 1]);

  auto failures = info;
  failures.status = at::full({batch}, static_cast<int64_t>(SolveStatus::kConverged), at::kLong);
  for (int64_t i = 0; i < batch; ++i) {
    const auto of_sample = static_cast<SolveStatus>(info.status.const_data_ptr<int64_t>()[i]);
    if (rows[i] && exact[i] && is_failure(of_sample))
      failures.status.mutable_data_ptr<int64_t>()[i] = static_cast<int64_t>(of_sample);
    if (rows[i]) continue;
    if (sound[i]) says(i, 0, 1.0, SolveStatus::kOverflow, 0);
    else says(i, 0, std::numeric_limits<double>::infinity(), SolveStatus::kNonfiniteInput, 0);
    failures.status.mutable_data_ptr<int64_t>()[i] = info.status.const_data_ptr<int64_t>()[i];
  }
  for (auto* part : {&info.residual, &info.floor}) *part = part->to(solved.b.scalar_type());
  if (options.adjoint_log != 0) adjoint_log::write(options.adjoint_log, info);
  report_failures({spec, options.solver, /*adjoint=*/true}, *a, cotangent, failures, options.on_failure);
  found.info = info;
  for (auto* part : found.info.parts()) *part = part->to(solved.b.device());
  return found;
}

/// The iterations, run again and taken back.
UnrolledVjp run_iterations_back(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                                at::IntArrayRef needed) {
  const auto method = solve.solver.method;
  const bool for_b_alone = std::count(needed.begin(), needed.end(), 1) == 1 && needed[0] == 1;
  if (traits(method).is_polynomial && for_b_alone) {
    // K iterations from zero are u = p(I - D⁻¹A) D⁻¹ b; transposed, that is K iterations with Aᵀ.
    auto transpose = solve.a;
    transpose.transposed = !transpose.transposed;
    const Solver transposed{method, 0, 0.0, solve.solver.restart, solve.solver.preconditioner.transposed()};
    const SolveRequest request{transposed, solve.iterations, /*guarded=*/false};
    const auto [b_bar, info] = prdp::solve(*make_operator(transpose), cotangent, request);
    UnrolledVjp found{std::vector<at::Tensor>(needed.size()), info.operator_applications};
    found.gradients[0] = b_bar;
    return found;
  }
  if (can_use_tape(*make_operator(solve.a), solve, b)) return tape_vjp(cotangent, b, solve, needed);
  return replay_vjp(cotangent, b, solve, needed);
}

/// The iterations, recorded all at once, and their derivative, recorded too.
UnrolledVjp record_iterations(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                              at::IntArrayRef needed) {
  // Partial derivatives: b and the tensors may be one tensor, or depend on each other further back.
  const auto rhs = at::alias(b);
  auto a = solve.a;
  for (auto& t : a.tensors) t = at::alias(t);
  const auto [u, applications] = solve_recorded(*make_operator(a), rhs, solve.x0, solve.solver, solve.iterations);
  UnrolledVjp found{std::vector<at::Tensor>(needed.size()), 2 * applications};
  std::vector<at::Tensor> inputs;
  for (size_t i = 0; i < needed.size(); ++i)
    if (needed[i]) inputs.push_back(i == 0 ? rhs : a.tensors[i - 1]);
  const auto gradients = torch::autograd::grad({u}, inputs, {cotangent}, /*retain_graph=*/true,
                                               /*create_graph=*/true, /*allow_unused=*/true);
  for (size_t i = 0, next = 0; i < needed.size(); ++i)
    if (needed[i]) found.gradients[i] = gradients[next++];
  return found;
}

template <class... Options>
Outputs vjp_kernel(const at::Tensor& cotangent, const at::Tensor& b, const at::Tensor& iterations,
                   const at::Tensor& status, const at::Tensor& residual, at::IntArrayRef needed, at::TensorList tensors,
                   c10::string_view kind, at::IntArrayRef shape, at::ArrayRef<double> parameters, bool transposed,
                   Options... flat) {
  const at::NoGradGuard no_grad;
  OperatorSpec a{std::string(kind), shape.vec(), parameters.vec(), {}, transposed};
  for (const auto& t : tensors) a.tensors.push_back(t.detach());
  make_operator(a)->check_parameters();
  const auto [options, x0] = unflatten_with_x0(std::move(flat)...);
  auto with_b = needed.vec();  // b̄ tells whether the derivative is one of the solution
  if (!traits(options.solver.method).is_polynomial) with_b[0] = 1;
  const auto found = vjp_of_samples(cotangent, {b.detach(), {}, iterations, status, residual, x0}, a, options, with_b,
                                    run_iterations_back, linear_solve_kernel);
  std::vector<at::Tensor> gradients;
  for (size_t i = 0; i < needed.size(); ++i)
    if (needed[i]) gradients.push_back(found.gradients[i]);
  const auto& info = found.info;
  // -1 crosses the op for no residual: torch's checks of ops compare outputs, and NaN equals nothing.
  const auto residual_or_not = info.residual.masked_fill(info.residual.isnan(), -1.0);
  return {gradients, info.iterations, residual_or_not, info.status, info.operator_applications, info.floor};
}

template <class... Options>
Outputs fake_kernel(const at::Tensor&, const at::Tensor& b, const at::Tensor&, const at::Tensor&, const at::Tensor&,
                    at::IntArrayRef needed, at::TensorList tensors, c10::string_view, at::IntArrayRef,
                    at::ArrayRef<double>, bool, Options...) {
  std::vector<at::Tensor> gradients;
  if (needed[0]) gradients.push_back(at::empty_symint(b.sym_sizes(), b.options()));
  for (size_t i = 0; i < tensors.size(); ++i)
    if (needed[i + 1]) gradients.push_back(at::empty_symint(tensors[i].sym_sizes(), tensors[i].options()));
  const auto of_dtype = [&](at::ScalarType dtype) {
    return at::empty_symint({b.sym_size(0)}, b.options().dtype(dtype));
  };
  return {gradients,           of_dtype(at::kLong), of_dtype(b.scalar_type()),
          of_dtype(at::kLong), of_dtype(at::kLong), of_dtype(b.scalar_type())};
}

}  // namespace

SolveVjp unrolled_vjp(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                      const SolveOptions& options, at::IntArrayRef needed) {
  static const auto op = c10::Dispatcher::singleton().findSchemaOrThrow("prdp::unrolled_vjp", "").typed<Signature>();
  const auto [gradients, iterations, residual, status, applications, floor] =
      call_with_x0(op, options, solved.x0, cotangent, solved.b, solved.iterations, solved.status, solved.residual,
                   needed, at::TensorList(a.tensors), c10::string_view(a.kind), at::IntArrayRef(a.shape),
                   at::ArrayRef<double>(a.parameters), a.transposed);
  const auto or_nan = residual.masked_fill(residual.lt(0), std::numeric_limits<double>::quiet_NaN());
  SolveVjp found{std::vector<at::Tensor>(needed.size()), {iterations, or_nan, status, applications, floor}};
  for (size_t i = 0, next = 0; i < needed.size(); ++i)
    if (needed[i]) found.gradients[i] = gradients[next++];
  return found;
}

SolveVjp unrolled_vjp_recorded(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                               const SolveOptions& options, at::IntArrayRef needed) {
  const at::AutoGradMode record(true);
  return vjp_of_samples(cotangent, solved, a, options, needed, record_iterations, linear_solve);
}

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def(kSchema, {at::Tag::pt2_compliant_tag}); }
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) { m.impl("unrolled_vjp", static_cast<Signature*>(vjp_kernel)); }
TORCH_LIBRARY_IMPL(prdp, Meta, m) { m.impl("unrolled_vjp", static_cast<Signature*>(fake_kernel)); }

}  // namespace prdp
