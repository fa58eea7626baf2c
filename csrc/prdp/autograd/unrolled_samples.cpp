#include "prdp/autograd/unrolled_samples.h"

#include <algorithm>
#include <limits>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/finite_rows.h"
#include "prdp/autograd/healthy_tensors.h"
#include "prdp/autograd/misleading_derivatives.h"
#include "prdp/autograd/solved_to_rounding.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/report_failures.h"
#include "prdp/solvers/solve.h"
#include "prdp/solvers/verdicts.h"

namespace prdp {

namespace {

/// Which derivative a sample gets.
enum class Derivative {
  kOfIterations,
  kOfSolution,
  kNone,     // its solve failed: it has no derivative, or on_failure says that it is to get none
  kRefused,  // none: its cotangent is not finite
};

/// The derivatives of a batch, sample by sample: classify, differentiate, retry, report.
class SampleVjps {
 public:
  SampleVjps(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& spec, const SolveOptions& options,
             at::IntArrayRef needed, OfIterations of_iterations, decltype(linear_solve)& any_solve)
      : cotangent_(cotangent),
        solved_(solved),
        spec_(spec),
        options_(options),
        needed_(needed),
        of_iterations_(of_iterations),
        any_solve_(any_solve) {}

  SolveVjp run() {
    if (needs_gradient_of_a_ && options_.solver.preconditioner.is_multigrid()) warn_of_constant_cycles();
    classify();
    found_ = differentiate(has_finite_cotangent_);
    retry_implicitly();
    if (zero_grad_) leave_out_failed_adjoints();
    fill_missing();
    finish_outcomes();
    return {std::move(found_.gradients), report()};
  }

 private:
  struct Differentiated {
    std::vector<at::Tensor> gradients;  // summed over samples; leave_out_failed_adjoints() takes some out, here alone
    std::vector<SampleOutcome> outcomes;  // of each sample
    Rows finite;  // the samples whose gradient is
    std::vector<std::vector<at::Tensor>> of_samples;  // as UnrolledVjp has them
  };

  const at::Tensor& cotangent_;
  const Solved& solved_;
  const OperatorSpec& spec_;
  const SolveOptions& options_;
  at::IntArrayRef needed_;
  OfIterations of_iterations_;
  decltype(linear_solve)& any_solve_;

  // Initialised in this order, each from those above. Later only derivatives_ (by classify() and retry_implicitly()),
  // found_ and u_ change.
  const int64_t batch_ = solved_.b.size(0);
  const std::unique_ptr<Operator> a_ = make_operator(spec_);
  // Of the forward solve.
  const std::vector<int64_t> counts_ = to_host<int64_t>(solved_.iterations, batch_);
  const std::vector<int64_t> statuses_ = to_host<int64_t>(solved_.status, batch_);
  const Rows has_finite_inverse_ = finite_inverses();
  const bool needs_gradient_of_a_ = std::find(needed_.begin() + 1, needed_.end(), 1) != needed_.end();
  const bool may_mislead_ = may_mislead(options_.solver);
  const std::vector<int64_t> needed_with_b_bar_ = needed_with_b_bar();  // which retry_implicitly() looks at
  const bool zero_grad_ = options_.on_failure == OnFailure::kZeroGrad;
  const double judged_rtol_ =
      options_.adjoint_rtol.value_or(options_.solver.rtol);  // by which adjoint solves are judged
  std::vector<Derivative> derivatives_{};
  const Rows has_finite_cotangent_ = finite_rows(cotangent_);  // the others are refused
  const at::Tensor finite_cotangent_ = only(cotangent_, has_finite_cotangent_);
  Differentiated found_{};
  at::Tensor u_{};

  Rows finite_inverses() const {
    const auto& m = options_.solver.preconditioner;
    return m.is_operator() ? has_finite_tensors(m.spec(), batch_) : Rows(batch_, true);
  }
  /// Whether a sample hands out an iterate that has a derivative. One that overflowed has none, nor has one that failed
  /// with a preconditioner of NaN.
  bool has_derivative(int64_t i) const {
    if (zero_grad_ && is_failure(status(i))) return false;
    return status(i) != SolveStatus::kOverflow && (has_finite_inverse_[i] || !is_failure(status(i)));
  }
  std::vector<int64_t> needed_with_b_bar() const {
    auto all = needed_.vec();
    if (needs_gradient_of_a_ && may_mislead_) all[0] = 1;
    return all;
  }
  Rows samples_with(Derivative derivative) const {
    Rows rows(batch_);
    for (int64_t i = 0; i < batch_; ++i) rows[i] = derivatives_[i] == derivative;
    return rows;
  }
  SolveStatus status(int64_t i) const { return static_cast<SolveStatus>(statuses_[i]); }

  void classify() {
    const auto exact = solved_to_rounding(*a_, solved_, options_.solver, [&] { return solution(); });
    for (int64_t i = 0; i < batch_; ++i)
      derivatives_.push_back(!has_finite_cotangent_[i] ? Derivative::kRefused
                             : exact[i]                ? Derivative::kOfSolution
                             : !has_derivative(i)      ? Derivative::kNone
                                                       : Derivative::kOfIterations);
  }

  /// The sum of these samples' gradients, without those that are not finite. To find them, finite_sum() calls the
  /// lambda for fewer and fewer samples, last for those that stay; each call overwrites the outcomes and of_samples of
  /// `found`, so that those of the last call remain.
  Differentiated differentiate(Rows rows) {
    Differentiated found;
    found.outcomes.resize(batch_);
    found.gradients = finite_sum(rows, [&](const Rows& some) {
      auto [sum, applications, of_samples] = vjp_of_iterations(some);
      found.of_samples = std::move(of_samples);
      const auto products = to_host<int64_t>(applications, batch_);
      for (int64_t i = 0; i < batch_; ++i)
        found.outcomes[i] = {status(i), counts_[i], products[i], std::numeric_limits<double>::quiet_NaN()};
      const auto solved = both(some, samples_with(Derivative::kOfSolution));
      if (any(solved)) add_adjoint_solves(solved, sum, found.outcomes);
      return sum;
    });
    found.finite = std::move(rows);
    return found;
  }

  UnrolledVjp vjp_of_iterations(const Rows& rows) const {
    auto caps = at::zeros({batch_}, at::kLong);
    auto runs = rows;
    for (int64_t i = 0; i < batch_; ++i) {
      runs[i] = rows[i] && derivatives_[i] == Derivative::kOfIterations && counts_[i] > 0;
      if (runs[i]) caps.mutable_data_ptr<int64_t>()[i] = counts_[i];
    }
    if (!any(runs)) return {std::vector<at::Tensor>(needed_.size()), at::zeros({batch_}, at::kLong)};
    UnrolledSolve solve{spec_, solved_.x0, options_.solver, caps.to(solved_.iterations.device()),
                        options_.checkpoint_every};
    auto b = solved_.b;
    auto& m = solve.solver.preconditioner;
    if (!all(runs) && (is_function(spec_) || m.is_operator())) {  // these cannot leave out samples that do not run
      solve.a = with_healthy_tensors(spec_, runs);
      if (m.is_operator()) m = with_healthy_tensors(m.spec(), runs);
      solve.x0 = with_healthy_rows(solved_.x0, runs);
      b = with_healthy_rows(b, runs);
    }
    return of_iterations_(only(finite_cotangent_, rows), b, solve, needed_with_b_bar_);
  }

  /// Adds the gradients of these samples to `sum`, and notes what came of their adjoint solves.
  void add_adjoint_solves(const Rows& rows, std::vector<at::Tensor>& sum, std::vector<SampleOutcome>& outcomes) {
    auto adjoint = options_;
    adjoint.backward = Backward::kImplicit;
    adjoint.checkpoint_every = 0;
    adjoint.adjoint_log = 0;
    adjoint.on_failure = OnFailure::kReturn;  // judged below, by the tolerance that was asked for
    adjoint.adjoint_rtol = std::min(judged_rtol_, kRoundings / 2 * epsilon_of(solved_.b));
    const auto u = needs_gradient_of_a_ ? solution() : at::Tensor();
    const auto found = implicit_vjp(only(finite_cotangent_, rows), u, spec_, adjoint, needed_with_b_bar_, any_solve_);
    for (size_t i = 0; i < sum.size(); ++i) add_to(sum[i], found.gradients[i]);
    const auto iterations = to_host<int64_t>(found.info.iterations, batch_);
    const auto residual = to_host<double>(found.info.residual, batch_);
    const auto statuses = to_host<int64_t>(found.info.status, batch_);
    const auto products = to_host<int64_t>(found.info.operator_applications, batch_);
    for (int64_t i = 0; i < batch_; ++i) {
      if (!rows[i]) continue;
      const auto said = static_cast<SolveStatus>(statuses[i]);
      const bool has_none = is_refused(said) || said == SolveStatus::kOverflow;  // no gradient, whatever its residual
      const bool good = !is_solved(said) && !has_none && residual[i] <= judged_rtol_;
      outcomes[i] = {good ? SolveStatus::kConverged : said, iterations[i], products[i], residual[i]};
    }
  }

  /// The implicit gradient takes the place of those that mislead (misleading_derivatives.h).
  void retry_implicitly() {
    if (!may_mislead_ || !found_.gradients[0].defined()) return;
    auto rows = both(both(solved_samples(solved_), samples_with(Derivative::kOfIterations)), found_.finite);
    if (!any(rows)) return;
    const auto allowed = allowed_disagreement(solved_, options_.solver);
    auto misleading = misleading_b_bar(*a_, finite_cotangent_, found_.gradients[0], rows, allowed);
    rows = except(rows, misleading);
    if (needs_gradient_of_a_ && any(rows)) {
      misleading = either(
          misleading, knows_shares_of_samples() ? misleading_alone(rows, allowed) : misleading_together(rows, allowed));
    }
    if (!any(misleading)) return;
    for (int64_t i = 0; i < batch_; ++i)
      if (misleading[i]) derivatives_[i] = Derivative::kOfSolution;
    found_ = differentiate(found_.finite);
  }

  /// Whether samples share a needed tensor of A, so that its gradient is a sum, and the share of each is known.
  bool knows_shares_of_samples() const {
    if (batch_ == 1 || found_.of_samples.empty()) return false;
    for (size_t k = 0; k < spec_.tensors.size(); ++k)
      if (needed_[k + 1] && !is_of_samples(spec_, k, batch_)) return true;
    return false;
  }
  /// Those whose Ā misleads, each judged by its own, so that its neighbours do not decide what it gets.
  Rows misleading_alone(const Rows& rows, const std::vector<double>& allowed) {
    Rows misleading(batch_);
    for (int64_t i = 0; i < batch_; ++i) {
      if (!rows[i]) continue;
      const auto of_sample = [&](const at::Tensor& t) { return t.defined() ? t.narrow(0, i, 1) : t; };
      auto a_of_sample = spec_;
      for (size_t k = 0; k < spec_.tensors.size(); ++k)
        if (is_of_samples(spec_, k, batch_)) a_of_sample.tensors[k] = of_sample(spec_.tensors[k]);
      auto gradients = found_.of_samples[i];
      gradients.insert(gradients.begin(), of_sample(found_.gradients[0]));
      gradients.resize(needed_.size());  // a sample may have added nothing
      misleading[i] = gradients[0].defined() && misleading_a_bar(a_of_sample, gradients, of_sample(solution()).detach(),
                                                                 needed_, {true}, {allowed[i]})[0];
    }
    return misleading;
  }
  Rows misleading_together(const Rows& rows, const std::vector<double>& allowed) {
    const auto found = gradients_of(rows);
    if (!found[0].defined()) return Rows(batch_);
    return misleading_a_bar(spec_, found, solution().detach(), needed_, rows, allowed);
  }
  /// The gradients of the iterations of these samples alone; undefined where none ran.
  std::vector<at::Tensor> gradients_of(const Rows& rows) const {
    bool others_contribute = false;
    for (int64_t i = 0; i < batch_; ++i)
      others_contribute = others_contribute || (!rows[i] && found_.finite[i] && derivatives_[i] != Derivative::kNone);
    return others_contribute ? vjp_of_iterations(rows).gradients : found_.gradients;
  }

  void leave_out_failed_adjoints() {
    Rows failed(batch_);
    for (int64_t i = 0; i < batch_; ++i) failed[i] = adjoint_failed(i);
    const auto good = except(found_.finite, failed);
    if (good != found_.finite) found_.gradients = differentiate(good).gradients;  // the failed stay in the report
  }
  bool adjoint_failed(int64_t i) const {
    return derivatives_[i] == Derivative::kOfSolution && is_failure(found_.outcomes[i].status);
  }

  void fill_missing() {
    auto& gradients = found_.gradients;
    if (!needed_[0]) gradients[0] = at::Tensor();
    for (size_t i = 0; i < needed_.size(); ++i)
      if (needed_[i] && !gradients[i].defined())
        gradients[i] = i == 0 ? only(cotangent_, Rows(batch_, false)) : at::zeros_like(spec_.tensors[i - 1]);
  }

  /// Tells the samples without a finite gradient.
  void finish_outcomes() {
    for (int64_t i = 0; i < batch_; ++i)
      if (!found_.finite[i])
        found_.outcomes[i] = zero_instead(derivatives_[i] == Derivative::kRefused ? SolveStatus::kNonfiniteInput
                                                                                  : SolveStatus::kOverflow);
  }
  SolveInfo report() {
    auto failures = found_.outcomes;  // the forward solve has reported its own
    for (int64_t i = 0; i < batch_; ++i)
      if (found_.finite[i] && !adjoint_failed(i)) failures[i].status = SolveStatus::kConverged;
    auto info = info_of(found_.outcomes, solved_.b.scalar_type());
    if (options_.adjoint_log != 0) adjoint_log::write(options_.adjoint_log, info);
    auto transpose = spec_;
    transpose.transposed = !spec_.transposed;
    const SolveRole role{transpose, options_.solver, /*adjoint=*/true, /*x0=*/{}, /*unrolled=*/true};
    report_failures(role, *make_operator(transpose), cotangent_, info_of(failures, solved_.b.scalar_type()),
                    options_.on_failure);
    for (auto* part : info.parts()) *part = part->to(solved_.b.device());
    return info;
  }

  /// u, solved for again, as it is not kept.
  const at::Tensor& solution() {
    auto silent = options_;
    silent.on_failure = OnFailure::kReturn;
    silent.adjoint_log = 0;
    if (!u_.defined()) u_ = any_solve_(spec_, solved_.b, silent, solved_.x0).u;
    return u_;
  }
};

}  // namespace

SolveVjp vjp_of_samples(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& spec,
                        const SolveOptions& options, at::IntArrayRef needed, OfIterations of_iterations,
                        decltype(linear_solve)& any_solve) {
  return SampleVjps(cotangent, solved, spec, options, needed, of_iterations, any_solve).run();
}

}  // namespace prdp
