#include "prdp/solvers/solve_samples.h"

#include "prdp/solvers/methods.h"
#include "prdp/solvers/sample_space.h"
#include "prdp/solvers/solve_sample.h"
#include "prdp/solvers/solved_ahead.h"

namespace prdp {

namespace {

template <class T>
void report(const SampleBatch<T>& batch, int64_t s, const SampleOutcome& outcome) {
  if (outcome.is_zero) std::fill_n(batch.arrays.u + s * batch.unknowns, batch.unknowns, T(0));
  batch.arrays.report.write(s, outcome);
}

/// Reports on a sample that needs no iterations, or gets none; returns false for all others. Without a kernel, A is not
/// finite.
template <class T>
bool report_if_settled(const SampleBatch<T>& batch, int64_t s, const GivenSample<T>& sample,
                       const kernels::Kernel<T>* a) {
  const T start = sample.x0 ? kernels::largest_magnitude(sample.x0, batch.unknowns) : T(0);
  const auto divides_by_zero = [&] { return divides_by_diagonal(batch.solver) && a->has_zero_diagonal(); };
  SampleOutcome outcome;
  if (!is_settled_beforehand(sample.magnitude, start, [&] { return a != nullptr; }, divides_by_zero, outcome))
    return false;
  report(batch, s, outcome);
  return true;
}

template <class T>
std::shared_ptr<const kernels::Factors<T>> factors_of(const kernels::Kernel<T>& a, const Solver& solver) {
  return traits(solver.method).is_direct ? a.factorise() : nullptr;
}

/// The samples that are to be iterated, from the first on: it reports on those in between.
template <class T>
class OpenSamples {
 public:
  OpenSamples(const kernels::KernelBatch<T>& kernels, const SharedSystem<T>* shared, const SampleBatch<T>& batch,
              int64_t begin, int64_t end)
      : kernels_(kernels), shared_(shared), batch_(batch), index_(begin - 1), end_(end) {
    if (shared && SolvedAhead<T>::pays(*shared, batch, end - begin))
      ahead_ = std::make_shared<SolvedAhead<T>>(*shared, batch, end);
  }

  /// Goes to the next one, and sets its system; false behind the last.
  bool next() {
    while (++index_ < end_) {
      if (!shared_) own_ = kernels_.make(index_);
      const auto* a = shared_ ? shared_->a.get() : own_.get();
      const T* const b = batch_.arrays.b + index_ * batch_.unknowns;
      given_ = batch_.arrays.sample(index_, batch_.unknowns, kernels::largest_magnitude(b, batch_.unknowns));
      if (report_if_settled(batch_, index_, given_, a)) continue;
      if (ahead_) ahead_->come_to(index_);
      if (shared_ && is_set_) return true;
      const auto& solver = batch_.solver;
      is_set_ = system_.set(*a, solver.preconditioner,
                            ahead_    ? ahead_
                            : shared_ ? shared_->factors
                                      : factors_of(*a, solver));
      if (is_set_) return true;
      report(batch_, index_, zero_instead(SolveStatus::kZeroDiagonal));
    }
    return false;
  }
  int64_t index() const { return index_; }
  const GivenSample<T>& given() const { return given_; }
  const SampleSystem<T>& system() const { return system_; }

 private:
  const kernels::KernelBatch<T>& kernels_;
  const SharedSystem<T>* shared_;
  const SampleBatch<T>& batch_;
  int64_t index_, end_;
  std::shared_ptr<SolvedAhead<T>> ahead_{};  // only where that pays
  std::unique_ptr<kernels::Kernel<T>> own_{};
  GivenSample<T> given_{};
  SampleSystem<T> system_{};
  bool is_set_ = false;  // the system
};

}  // namespace

template <class T>
std::unique_ptr<SharedSystem<T>> shared_system(const kernels::KernelBatch<T>& kernels, const Solver& solver) {
  if (!kernels.is_shared) return nullptr;
  auto a = kernels.make(0);
  if (a && traits(solver.method).is_direct) a->leave_source();
  return system_of<T>(std::move(a), solver);
}
template <class T>
std::unique_ptr<SharedSystem<T>> system_of(std::shared_ptr<const kernels::Kernel<T>> a, const Solver& solver) {
  auto factors = a ? factors_of(*a, solver) : nullptr;
  return std::make_unique<SharedSystem<T>>(SharedSystem<T>{std::move(a), std::move(factors)});
}

template <class T>
void solve_samples(const kernels::KernelBatch<T>& kernels, const SharedSystem<T>* shared, const SampleBatch<T>& batch,
                   int64_t begin, int64_t end) {
  OpenSamples<T> open(kernels, shared, batch, begin, end);
  if (!open.next()) return;
  auto& workspace = kernels::Workspace<T>::local();
  const auto method = batch.solver.method;
  const int64_t restart = std::min(batch.solver.restart, batch.unknowns);
  const bool starts = batch.arrays.x0 != nullptr;
  const auto& a = open.system().a();
  workspace.prepare(SampleSpace<T>::vectors(starts) + vectors_of(method, restart), a.length(), a.layout().halo);
  SampleSpace<T> space(open.system(), workspace, starts);
  with_method(method, restart, space, [&](auto iteration) {
    do {
      const auto outcome = solve_sample(space, iteration, open.given());
      report(batch, open.index(), outcome);
      // Whatever a failure left in the padding must not reach the next sample.
      if (is_failure(outcome.status)) space.clear();
    } while (open.next());
  });
}

template std::unique_ptr<SharedSystem<float>> shared_system(const kernels::KernelBatch<float>&, const Solver&);
template std::unique_ptr<SharedSystem<double>> shared_system(const kernels::KernelBatch<double>&, const Solver&);
template std::unique_ptr<SharedSystem<float>> system_of(std::shared_ptr<const kernels::Kernel<float>>, const Solver&);
template std::unique_ptr<SharedSystem<double>> system_of(std::shared_ptr<const kernels::Kernel<double>>, const Solver&);
template void solve_samples(const kernels::KernelBatch<float>&, const SharedSystem<float>*, const SampleBatch<float>&,
                            int64_t, int64_t);
template void solve_samples(const kernels::KernelBatch<double>&, const SharedSystem<double>*,
                            const SampleBatch<double>&, int64_t, int64_t);

}  // namespace prdp
