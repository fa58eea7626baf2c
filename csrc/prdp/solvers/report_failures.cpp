#include "prdp/solvers/report_failures.h"

#include <c10/util/Exception.h>

#include <algorithm>
#include <sstream>
#include <tuple>

#include "prdp/error_text.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/failure_messages.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/unfit.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

namespace {

/// What a solve has given, on the host, and how it is told of.
struct Report {
  const SolveRole& role;
  const Operator& a;
  const at::Tensor& b;
  const SolveInfo& info;
  std::vector<int64_t> statuses, iterations;
  std::vector<double> residuals;

  Report(const SolveRole& of, const Operator& a, const at::Tensor& b, const SolveInfo& info)
      : role(of),
        a(a),
        b(b),
        info(info),
        statuses(to_host<int64_t>(info.status, b.size(0))),
        iterations(to_host<int64_t>(info.iterations, b.size(0))),
        residuals(to_host<double>(info.residual, b.size(0))) {}

  int64_t batch() const { return b.size(0); }
  double rtol() const { return role.solver.rtol; }
  SolveStatus status(int64_t i) const { return static_cast<SolveStatus>(statuses[i]); }
  const char* who() const { return role.adjoint ? "adjoint solve" : "linear_solve"; }
  /// Residuals above this are worth a warning.
  double large_residual() const { return std::max(10.0 * rtol(), 0.01); }
  /// The one of these samples with the largest residual.
  int64_t worst_of(const std::vector<int64_t>& samples) const {
    return *std::max_element(samples.begin(), samples.end(),
                             [&](int64_t i, int64_t j) { return residuals[i] < residuals[j]; });
  }
  /// The samples of which `is_meant`.
  template <class Predicate>
  std::vector<int64_t> samples_where(const Predicate& is_meant) const {
    std::vector<int64_t> samples;
    for (int64_t i = 0; i < batch(); ++i)
      if (is_meant(i)) samples.push_back(i);
    return samples;
  }
  /// What tells a warning about one kind of solve from another.
  std::string key() const {
    const auto& solver = role.solver;
    std::ostringstream text;
    text << who() << name(solver.method) << ' ' << solver.preconditioner.spec().kind << ' ' << role.a.kind << ' '
         << b.sizes().slice(1);  // another grid is another problem
    return text.str();
  }
  /// "linear_solve: 2 of 8 samples", what `say` writes of one of them, and why it ended so; once.
  template <class Say>
  void warn(const char* kind, size_t samples, int64_t sample, SolveStatus because, const Say& say,
            const char* end = "") const {
    warn_once(kind + key(), residuals[sample], [&](std::ostream& text) {
      text << who() << ": " << samples << " of " << batch() << " samples ";
      say(text);
      text << ", " << diagnosis({role, a, b, sample}, because) << end;
    });
  }
};

/// Where in b, in the start or in A the trouble of this sample sits.
std::string whereabouts(const Report& report, int64_t sample) {
  const auto& [a, b, x0] = std::tie(report.a, report.b, report.role.x0);
  const auto status = report.status(sample);
  if (status == SolveStatus::kNonfiniteInput) {
    const auto of_b = nonfinite(b.select(0, sample));
    const bool in_b = !x0.defined() || of_b.any().item<bool>();
    return c10::str(in_b ? "" : " in x0", " at index ",
                    as_tuple(first_true(in_b ? of_b : nonfinite(x0.select(0, sample)))));
  }
  if (status == SolveStatus::kZeroDiagonal)
    // None where it is the diagonal of a coarse grid.
    if (const auto zero = a.diagonal().expand_as(b).select(0, sample).eq(0); zero.any().item<bool>())
      return " in row " + as_tuple(first_true(zero));
  if (status == SolveStatus::kNonfiniteOperator)
    if (const auto index = a.first_nonfinite(sample); !index.empty()) return " at index " + as_tuple(index);
  return {};
}

/// Of samples whose residual stopped far above what was asked for. That is no failure: the residual may be all that
/// rounding leaves of a u that is good enough, but nobody else would say that it may not be. Returns whether there are
/// any.
bool warn_of_stagnation(const Report& report) {
  auto stagnated = report.samples_where([&](int64_t i) {
    return report.status(i) == SolveStatus::kStagnated && report.residuals[i] > report.large_residual();
  });
  if (stagnated.empty()) return false;
  // Where residual and floor are equal, u consists of the least numbers of its dtype, and that is their rounding.
  const auto floors = to_host<double>(report.info.floor, report.batch());
  std::erase_if(stagnated, [&](int64_t i) { return report.residuals[i] == floors[i]; });
  if (stagnated.empty()) return false;
  const int64_t worst = report.worst_of(stagnated);
  report.warn("", stagnated.size(), worst, SolveStatus::kStagnated, [&](std::ostream& text) {
    text << "STAGNATED far above rtol = " << report.rtol() << ": sample " << worst << " at relative residual "
         << report.residuals[worst] << " after " << report.iterations[worst] << " iterations";
  });
  return true;
}

/// warn_of_lost_cotangents() of an adjoint solve. Only what the host has is looked at: nobody waits for a device.
void look_for_lost_cotangents(const SolveRole& role, const SolveInfo& info) {
  if (!role.adjoint || !info.status.is_cpu()) return;
  const auto* status = info.status.const_data_ptr<int64_t>();
  const auto lost =
      std::count(status, status + info.status.size(0), static_cast<int64_t>(SolveStatus::kNonfiniteInput));
  if (lost > 0) warn_of_lost_cotangents("adjoint solve", lost, info.status.size(0));
}

/// Whether max_iter stopped a sample far from its tolerance whose later iterations were in vain: its answer is the
/// start, mostly zero, or comes from the first half of many iterations. Of fewer, residuals may yet fall.
bool later_iterations_were_worse(const Report& report, int64_t sample) {
  constexpr int64_t many_iterations = 20;
  const int64_t max_iter = report.role.solver.max_iter.expect_int(), iterations = report.iterations[sample];
  if (report.status(sample) != SolveStatus::kMaxIter || !(report.residuals[sample] > report.large_residual()))
    return false;
  return max_iter > 0 && (iterations == 0 || (max_iter >= many_iterations && iterations < max_iter / 2));
}

/// Of samples that max_iter left with a residual above ‖b‖, or a direct method with a large one. That is no failure, as
/// an error may fall where its residual grows, but whoever asked for a tolerance did not mean it. Returns whether there
/// are any.
bool warn_of_growth(const Report& report) {
  const bool is_direct = traits(report.role.solver.method).is_direct;
  const double bound = is_direct ? report.large_residual() : 1.0;
  const auto grown = report.samples_where([&](int64_t i) {
    const bool has_solved = !is_direct || report.iterations[i] > 0;  // max_iter may be 0
    return report.status(i) == SolveStatus::kMaxIter && report.residuals[i] > bound && has_solved;
  });
  if (grown.empty()) return false;
  const int64_t worst = report.worst_of(grown);
  const auto say = [&](std::ostream& text) {
    text << "stopped at max_iter = " << report.role.solver.max_iter << ", with a "
         << (is_direct ? "large residual" : "residual above ‖b‖") << ": sample " << worst << " at "
         << report.residuals[worst] << ", where rtol = " << report.rtol() << " was asked for";
  };
  const char* const end = is_direct ? "" : "; or rtol=0 if so few are meant, as by PRDPController";
  report.warn("grown: ", grown.size(), worst, SolveStatus::kMaxIter, say, end);
  return true;
}

/// Of samples that max_iter stopped far from the tolerance that was asked for; without one, of those whose iterates
/// were all in vain. Returns whether there are any.
bool warn_of_stopped(const Report& report) {
  const bool has_tolerance = report.rtol() > 0.0;
  const auto worse = report.samples_where([&](int64_t i) {
    return later_iterations_were_worse(report, i) && (has_tolerance || report.iterations[i] == 0);
  });
  if (worse.empty()) return has_tolerance && warn_of_growth(report);
  const int64_t first = worse.front();
  report.warn("in vain: ", worse.size(), first, SolveStatus::kMaxIter, [&](std::ostream& text) {
    if (has_tolerance) text << "ended far above rtol = " << report.rtol();
    else text << "gained nothing";
    text << ": sample " << first << " returned ";
    if (report.iterations[first] > 0) text << "iterate " << report.iterations[first];
    else text << (report.role.x0.defined() ? "its start" : "zero");
    text << " at relative residual " << report.residuals[first] << ", as the last of " << report.role.solver.max_iter
         << " iterates was worse";
  });
  return true;
}

/// Whether max_iter left a sample where it started. Only what the host has is looked at: nobody waits for a device.
bool has_an_idle_sample(const SolveInfo& info) {
  if (!info.iterations.is_cpu()) return false;
  const auto *iterations = info.iterations.const_data_ptr<int64_t>(), *status = info.status.const_data_ptr<int64_t>();
  for (int64_t i = 0; i < info.iterations.size(0); ++i)
    if (iterations[i] == 0 && status[i] == static_cast<int64_t>(SolveStatus::kMaxIter)) return true;
  return false;
}

/// Whether a sample is far from rtol after as many products as unknowns, in which a Krylov method should have ended.
bool has_had_enough(const Report& report, int64_t sample, int64_t products) {
  const bool is_krylov = traits(report.role.solver.method).takes_preconditioner;
  const int64_t unknowns = report.b.numel() / report.batch();
  return is_krylov && products >= unknowns && report.residuals[sample] > report.large_residual();
}

/// Where many products did not lead to rtol, though no residual grew, as A or a preconditioner of one's own is not what
/// the method is made for. After fewer, the products that tell would cost too much beside the solve.
void warn_of_unfit(const Report& report, const std::vector<int64_t>& unsolved) {
  constexpr double many_products = 100.0;
  const auto& solver = report.role.solver;
  if (!(solver.rtol > 0.0) || steps_of(solver.method, solver.max_iter.expect_int(), solver.restart) < many_products)
    return;
  if (!should_look(std::hash<std::string>()(report.key()))) return;
  const int64_t worst = report.worst_of(unsolved);
  const auto products = report.info.operator_applications[worst].item<int64_t>();
  const double bound = 10.0 * std::max(solver.rtol, report.info.floor[worst].item<double>());
  if (static_cast<double>(products) < many_products || !(report.residuals[worst] > bound)) return;
  if (!has_had_enough(report, worst, products) && unfit({report.role, report.a, report.b, worst}).empty()) return;
  report.warn("unfit: ", unsolved.size(), worst, SolveStatus::kMaxIter, [&](std::ostream& text) {
    text << "did not reach rtol = " << solver.rtol << ": sample " << worst << " is at relative residual "
         << report.residuals[worst] << " after " << products << " products with A";
  });
}

/// "linear_solve: 2 of 8 samples failed: sample 3 DIVERGED (…), Jacobi on …; sample 5 …".
std::string failure_text(const Report& report, const std::vector<int64_t>& failed) {
  constexpr size_t named = 4;
  std::ostringstream text;
  text << report.who() << ": " << failed.size() << " of " << report.batch() << " samples failed";
  std::string said;
  for (size_t k = 0; k < std::min(named, failed.size()); ++k) {
    const int64_t i = failed[k];
    const auto status = report.status(i);
    text << (k ? "; " : ": ") << "sample " << i << " " << name(status) << whereabouts(report, i);
    if (!is_refused(status))
      text << " (the iterate handed out has relative residual " << report.residuals[i] << " after "
           << report.iterations[i] << " iterations)";
    const auto why = diagnosis({report.role, report.a, report.b, i}, status);
    if (why != said) text << ", " << why;
    said = why;
  }
  if (failed.size() > named) text << "; and " << failed.size() - named << " more";
  return text.str();
}

/// A preconditioner is M⁻¹ here, and M in some other libraries.
void warn_of_another_convention(const SolveRole& role, const Operator& a, const at::Tensor& b) {
  const auto& preconditioner = role.solver.preconditioner;
  if (role.adjoint || !preconditioner.is_operator() || !b.is_cpu() || b.numel() == 0) return;
  const auto key = c10::str("convention", name(role.solver.method), preconditioner.spec().kind, role.a.kind, b.sizes());
  if (!should_look(std::hash<std::string>()(key)) || !preconditions_with_operator({role, a, b, 0})) return;
  warn_once(key, 0.0, [](std::ostream& text) {
    text << "linear_solve: the preconditioner resembles A; it should resemble the inverse of A, as it is applied as "
            "M⁻¹";
  });
}

bool was_warned_of(FunctionCode& code) {
  return code.warned_of_product.exchange(true) && !c10::WarningUtils::get_warnAlways();
}

}  // namespace

void report_failures(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveInfo& info,
                     OnFailure on_failure) {
  if (on_failure == OnFailure::kReturn || on_failure == OnFailure::kZeroGrad)
    return look_for_lost_cotangents(role, info);
  warn_of_another_convention(role, a, b);
  const auto on_host = info.status.to(at::kCPU);
  const auto* first = on_host.const_data_ptr<int64_t>();
  const auto is_told = [&](int64_t s) {  // MAX_ITER without a tolerance is what was asked for
    const auto status = static_cast<SolveStatus>(s);
    return !is_solved(status) && (status != SolveStatus::kMaxIter || role.solver.rtol > 0.0);
  };
  if (std::none_of(first, first + b.size(0), is_told) && !has_an_idle_sample(info)) return;
  const Report report(role, a, b, info);
  const auto failed = report.samples_where([&](int64_t i) { return is_failure(report.status(i)); });
  if (failed.empty()) {
    const auto unsolved = report.samples_where([&](int64_t i) { return !is_solved(report.status(i)); });
    const bool have_stopped = warn_of_stopped(report), have_stagnated = warn_of_stagnation(report);
    if (!have_stopped && !have_stagnated) warn_of_unfit(report, unsolved);
    return;
  }
  const auto has_nonfinite_operator = [&](int64_t i) { return report.status(i) == SolveStatus::kNonfiniteOperator; };
  if (std::any_of(failed.begin(), failed.end(), has_nonfinite_operator))  // a kernel may have found it
    a.check_parameters(checks_of(on_failure));
  raise_or_warn(failure_text(report, failed), on_failure);
}

void warn_of_lost_cotangents(const std::string& who, int64_t lost, int64_t batch) {
  warn_once("cotangents", 0.0, [&](std::ostream& text) {
    text << who << ": the cotangent of " << lost << " of " << batch
         << " samples contains NaN or Inf, and their gradient is zero"
         << in_language(
                ". A GradScaler cannot see that: take bfloat16 without one, or a small scale that stays, such "
                "as GradScaler(init_scale=256.0, growth_interval=10**9)",
                "");
  });
}

void warn_of_constant_preconditioner() {
  warn_once("constant preconditioner", 0.0, [](std::ostream& text) {
    text << "linear_solve: the tensors of the preconditioner require grad and get none: in unrolled mode, too, it "
            "counts "
            "as a constant; detach them if this is meant";
  });
}

void warn_of_constant_cycles() {
  warn_once("constant cycles", 0.0, [](std::ostream& text) {
    text << in_language("backward=\"unrolled\"", "Backward::kUnrolled")
         << ": the gradient of A leaves out how the cycles of multigrid depend on A, which is all of it after one "
            "iteration; take "
         << in_language("backward=\"implicit\"", "Backward::kImplicit");
  });
}

void warn_of_another_transpose(FunctionCode& code, int64_t sample, double of_solve, double of_adjoint) {
  if (was_warned_of(code)) return;
  std::ostringstream text;
  text << "adjoint solve: the gradient of sample " << sample
       << " is wrong, as this Function's transpose is not that of the A that was solved: ⟨λ, b⟩ = " << of_solve
       << " and ⟨u, ū⟩ = " << of_adjoint << " should be equal. Is "
       << in_language("`transpose` right, or A symmetric where symmetric=True", "`apply_transpose` right")
       << ", and do the functions still see what they captured, tensors and numbers? "
       << in_language("prdp.check_operator tells", "To check: ⟨v, A u⟩ = ⟨Aᵀ v, u⟩ for random u and v");
  warn_this_once(text.str(), /*may_get_worse=*/false);
}

void warn_of_another_product(FunctionCode& code, int64_t sample, double now, double before) {
  if (was_warned_of(code)) return;
  std::ostringstream text;
  text << "unrolled solve: the gradient of sample " << sample
       << " is wrong, as this Function is not the A that was solved: |b - A u| is " << three_digits(now)
       << " |b| now, and was " << three_digits(before)
       << ". Do the functions still see what they captured, tensors and numbers? Pass what changes in "
       << in_language("`tensors`", "its tensors");
  warn_this_once(text.str(), /*may_get_worse=*/false);
}

}  // namespace prdp
