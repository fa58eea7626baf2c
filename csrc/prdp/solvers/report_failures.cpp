#include "prdp/solvers/report_failures.h"

#include <c10/util/Exception.h>

#include <algorithm>
#include <bit>
#include <map>
#include <mutex>
#include <sstream>

#include "prdp/error_text.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/failure_messages.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/unfit.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

namespace {

/// "(0, 17)"
std::string position(const std::vector<int64_t>& index) {
  std::ostringstream text;
  for (size_t d = 0; d < index.size(); ++d) text << (d ? ", " : "(") << index[d];
  text << ")";
  return text.str();
}

/// Where in b, in the start or in A the trouble of this sample sits.
std::string whereabouts(const Operator& a, const at::Tensor& b, const at::Tensor& x0, SolveStatus status,
                        int64_t sample) {
  std::ostringstream text;
  if (status == SolveStatus::kNonfiniteInput) {
    const auto of_b = nonfinite(b.select(0, sample));
    const bool in_b = !x0.defined() || of_b.any().item<bool>();
    text << (in_b ? "" : " in x0") << " at index "
         << position(first_true(in_b ? of_b : nonfinite(x0.select(0, sample))));
  }
  if (status == SolveStatus::kZeroDiagonal)
    // None where it is the diagonal of a coarse grid.
    if (const auto zero = a.diagonal().expand_as(b).select(0, sample).eq(0); zero.any().item<bool>())
      text << " in row " << position(first_true(zero));
  if (status == SolveStatus::kNonfiniteOperator)
    if (const auto index = a.first_nonfinite(sample); !index.empty()) text << " at index " << position(index);
  return text.str();
}

const char* name_of(const SolveRole& role) { return role.adjoint ? "adjoint solve" : "linear_solve"; }

/// What tells a warning about one kind of solve from another.
std::string key_of(const SolveRole& role) {
  const auto& solver = role.solver;
  return name_of(role) + std::string(name(solver.method)) + " " + solver.preconditioner.spec().kind + " " + role.a.kind;
}

/// Residuals above this are reported.
double warning_threshold(double rtol) { return std::max(10.0 * rtol, 0.01); }

/// The one of these samples with the largest residual.
int64_t worst_of(const std::vector<int64_t>& samples, const std::vector<double>& residual) {
  return *std::max_element(samples.begin(), samples.end(),
                           [&](int64_t i, int64_t j) { return residual[i] < residual[j]; });
}

/// Warns of samples whose residual stopped far above what was asked for, and returns whether there are any. That is no
/// failure: the residual may be all that rounding leaves of a u that is good enough, but nobody else would say that it
/// may not be.
bool warn_of_stagnation(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveInfo& info,
                        const std::vector<int64_t>& stagnated) {
  if (stagnated.empty()) return false;
  // Where the two are equal, u consists of the least numbers of its dtype, and the residual of their rounding.
  const auto residual = to_host<double>(info.residual.masked_fill(info.residual.eq(info.floor), 0.0), b.size(0));
  const double bound = warning_threshold(role.solver.rtol);
  const int64_t worst = worst_of(stagnated, residual);
  if (!(residual[worst] > bound)) return false;
  const auto many = std::count_if(stagnated.begin(), stagnated.end(), [&](int64_t i) { return residual[i] > bound; });
  warn_once(key_of(role), residual[worst], [&](std::ostream& text) {
    text << name_of(role) << ": " << many << " of " << b.size(0)
         << " samples STAGNATED far above rtol = " << role.solver.rtol << ": sample " << worst
         << " at relative residual " << residual[worst] << " after " << info.iterations[worst].item<int64_t>()
         << " iterations, " << diagnosis({role, a, b, worst}, SolveStatus::kStagnated);
  });
  return true;
}

/// warn_of_lost_cotangents() of an adjoint solve. Only what the host has is looked at: nobody waits for a device.
void look_for_lost_cotangents(const SolveRole& role, const SolveInfo& info) {
  if (!role.adjoint || !info.status.is_cpu()) return;
  const auto status = info.status.accessor<int64_t, 1>();
  int64_t lost = 0;
  for (int64_t i = 0; i < status.size(0); ++i)
    lost += static_cast<SolveStatus>(status[i]) == SolveStatus::kNonfiniteInput;
  if (lost > 0) warn_of_lost_cotangents(name_of(role), lost, status.size(0));
}

/// Whether max_iter stopped a sample far from its tolerance whose later iterations were in vain: its answer is the
/// start, mostly zero, or comes from the first half of many. Below so many, residuals may yet fall.
bool later_iterations_were_worse(const Solver& solver, SolveStatus status, int64_t iterations, double residual) {
  const int64_t max_iter = solver.max_iter.expect_int();
  constexpr int64_t many = 20;
  if (status != SolveStatus::kMaxIter || !(residual > warning_threshold(solver.rtol))) return false;
  return max_iter > 0 && (iterations == 0 || (max_iter >= many && iterations < max_iter / 2));
}

/// Warns of those that max_iter left with a residual above ‖b‖. That is no failure, as an error may fall where its
/// residual grows, but whoever asked for a tolerance did not mean it. Returns whether there are any.
bool warn_of_growth(const SolveRole& role, const Operator& a, const at::Tensor& b, const std::vector<int64_t>& status,
                    const std::vector<double>& residual) {
  std::vector<int64_t> grown;
  for (int64_t i = 0; i < b.size(0); ++i)
    if (static_cast<SolveStatus>(status[i]) == SolveStatus::kMaxIter && residual[i] > 1.0) grown.push_back(i);
  if (grown.empty()) return false;
  const int64_t worst = worst_of(grown, residual);
  warn_once("grown: " + key_of(role), residual[worst], [&](std::ostream& text) {
    text << name_of(role) << ": " << grown.size() << " of " << b.size(0)
         << " samples stopped at max_iter = " << role.solver.max_iter << ", with a residual above ‖b‖: sample " << worst
         << " at " << residual[worst] << ", where rtol = " << role.solver.rtol << " was asked for, "
         << diagnosis({role, a, b, worst}, SolveStatus::kMaxIter) << "; or rtol=0 if this is meant";
  });
  return true;
}

/// Whether this is the 1st, 2nd, 4th, 8th, … time, so that looks cost little however often they are asked for.
bool should_look(const std::string& at) {
  static std::mutex mutex;
  static std::map<std::string, uint64_t> times;
  const std::lock_guard lock(mutex);
  return std::has_single_bit(++times[at]) || c10::WarningUtils::get_warnAlways();
}

/// Warns where many products did not lead to rtol, though no residual grew, as A or a preconditioner of one's own is
/// not what the method is made for. Below so many, the products that tell would cost too much beside the solve.
void warn_of_unfit(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveInfo& info,
                   const std::vector<int64_t>& unsolved) {
  constexpr double many = 100.0;
  const auto& s = role.solver;
  if (!(s.rtol > 0.0) || steps_of(s.method, s.max_iter.expect_int(), s.restart) < many) return;
  if (!should_look(key_of(role))) return;
  const auto residual = to_host<double>(info.residual, b.size(0)), floor = to_host<double>(info.floor, b.size(0));
  const auto products = to_host<int64_t>(info.operator_applications, b.size(0));
  const int64_t worst = worst_of(unsolved, residual);
  const double bound = 10.0 * std::max(s.rtol, floor[worst]);
  if (static_cast<double>(products[worst]) < many || !(residual[worst] > bound)) return;
  if (unfit({role, a, b, worst}).empty()) return;
  warn_once("unfit: " + key_of(role), residual[worst], [&](std::ostream& text) {
    text << name_of(role) << ": " << unsolved.size() << " of " << b.size(0)
         << " samples did not reach rtol = " << s.rtol << ": sample " << worst << " is at relative residual "
         << residual[worst] << " after " << products[worst] << " products with A, "
         << diagnosis({role, a, b, worst}, SolveStatus::kMaxIter);
  });
}

/// Warns of samples that max_iter stopped, where a tolerance was asked for. Returns whether there are any that are far
/// from it.
bool warn_of_stopped(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveInfo& info) {
  if (!(role.solver.rtol > 0.0)) return false;
  const auto iterations = to_host<int64_t>(info.iterations, b.size(0)),
             status = to_host<int64_t>(info.status, b.size(0));
  const auto residual = to_host<double>(info.residual, b.size(0));
  std::vector<int64_t> stopped_worse;
  for (int64_t i = 0; i < b.size(0); ++i)
    if (later_iterations_were_worse(role.solver, static_cast<SolveStatus>(status[i]), iterations[i], residual[i]))
      stopped_worse.push_back(i);
  if (stopped_worse.empty()) return warn_of_growth(role, a, b, status, residual);
  warn_once("in vain: " + key_of(role), residual[stopped_worse.front()],
            [&, first = stopped_worse.front()](std::ostream& text) {
              text << name_of(role) << ": " << stopped_worse.size() << " of " << b.size(0)
                   << " samples ended far above rtol = " << role.solver.rtol << ": sample " << first << " returned "
                   << (iterations[first] > 0 ? "iterate " + std::to_string(iterations[first])
                       : role.x0.defined()   ? "its start"
                                             : "zero")
                   << " at relative residual " << residual[first] << ", as the last of " << role.solver.max_iter
                   << " iterates was worse, " << diagnosis({role, a, b, first}, SolveStatus::kMaxIter);
            });
  return true;
}

}  // namespace

void report_failures(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveInfo& info,
                     OnFailure on_failure) {
  if (on_failure == OnFailure::kReturn || on_failure == OnFailure::kZeroGrad)
    return look_for_lost_cotangents(role, info);
  const int64_t batch = info.status.size(0);
  const auto on_host = info.status.to(at::kCPU);
  const auto* status = on_host.const_data_ptr<int64_t>();
  std::vector<int64_t> failed, stagnated, unsolved;
  for (int64_t i = 0; i < batch; ++i) {
    const auto what = static_cast<SolveStatus>(status[i]);
    if (is_failure(what)) failed.push_back(i);
    if (what == SolveStatus::kStagnated) stagnated.push_back(i);
    if (what == SolveStatus::kStagnated || what == SolveStatus::kMaxIter) unsolved.push_back(i);
  }
  if (failed.empty()) {
    const bool have_stopped = unsolved.size() > stagnated.size() && warn_of_stopped(role, a, b, info);
    const bool have_stagnated = warn_of_stagnation(role, a, b, info, stagnated);
    if (!have_stopped && !have_stagnated && !unsolved.empty()) warn_of_unfit(role, a, b, info, unsolved);
    return;
  }
  const auto has_nonfinite_operator = [&](int64_t i) {
    return static_cast<SolveStatus>(status[i]) == SolveStatus::kNonfiniteOperator;
  };
  if (std::any_of(failed.begin(), failed.end(), has_nonfinite_operator))  // a kernel may have found it
    a.check_parameters(checks_of(on_failure));

  constexpr size_t named = 4;
  std::ostringstream text;
  text << name_of(role) << ": " << failed.size() << " of " << batch << " samples failed";
  std::string said;
  for (size_t k = 0; k < std::min(named, failed.size()); ++k) {
    const int64_t i = failed[k];
    const auto what = static_cast<SolveStatus>(status[i]);
    text << (k ? "; " : ": ") << "sample " << i << " " << name(what) << whereabouts(a, b, role.x0, what, i);
    if (!is_refused(what))
      text << " (the iterate handed out has relative residual " << info.residual[i].item<double>() << " after "
           << info.iterations[i].item<int64_t>() << " iterations)";
    const auto why = diagnosis({role, a, b, i}, what);
    if (why != said) text << ", " << why;
    said = why;
  }
  if (failed.size() > named) text << "; and " << failed.size() - named << " more";
  raise_or_warn(text.str(), on_failure);
}

void warn_of_lost_cotangents(const std::string& who, int64_t lost, int64_t batch) {
  warn_once("cotangents", 0.0, [&](std::ostream& text) {
    text << who << ": the cotangent of " << lost << " of " << batch
         << " samples contains NaN or Inf, and their gradient is zero. A GradScaler cannot see that: take bfloat16 "
            "without one, or a small scale that stays"
         << in_language(", such as GradScaler(init_scale=256.0, growth_interval=10**9)", "");
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
  if (code.warned_of_transpose.exchange(true) && !c10::WarningUtils::get_warnAlways()) return;
  std::ostringstream text;
  text << "adjoint solve: the gradient of sample " << sample
       << " is wrong, as this Function's transpose is not that of the A that was solved: ⟨λ, b⟩ = " << of_solve
       << " and ⟨u, ū⟩ = " << of_adjoint << " should be equal. Is "
       << in_language("`transpose` right, or A symmetric where symmetric=True", "`apply_transpose` right")
       << ", and do the functions still see the tensors that they captured? "
       << in_language("prdp.check_operator tells", "To check: ⟨v, A u⟩ = ⟨Aᵀ v, u⟩ for random u and v");
  warn_this_once(text.str(), /*may_get_worse=*/false);
}

}  // namespace prdp
