#include "prdp/solvers/solve_samples.h"

#include "prdp/solvers/methods.h"
#include "prdp/solvers/sample_space.h"
#include "prdp/solvers/solve_sample.h"

namespace prdp {

namespace {

template <class T>
void report(const SampleBatch<T>& batch, int64_t s, const SampleOutcome& outcome) {
  if (outcome.is_zero) std::fill_n(batch.u + s * batch.unknowns, batch.unknowns, T(0));
  batch.status[s] = static_cast<int64_t>(outcome.status);
  batch.iterations[s] = outcome.iterations;
  batch.residual[s] = static_cast<T>(outcome.residual);
  batch.applications[s] = outcome.applications;
  batch.floor[s] = static_cast<T>(outcome.floor);
}

template <class T>
GivenSample<T> given_sample(const SampleBatch<T>& batch, int64_t s) {
  const T* const b = batch.b + s * batch.unknowns;
  const bool starts = batch.x0 && !traits(batch.solver.method).is_direct;
  return {.b = b,
          .x0 = starts ? batch.x0 + s * batch.unknowns : nullptr,
          .u = batch.u + s * batch.unknowns,
          .magnitude = kernels::largest_magnitude(b, batch.unknowns),
          .cap = batch.caps ? batch.caps[s] : batch.max_iter,
          .rtol = batch.solver.rtol,
          .guarded = batch.guarded};
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
  std::unique_ptr<kernels::Kernel<T>> own;
  SampleSystem<T> system;
  const auto kernel_of = [&](int64_t s) -> const kernels::Kernel<T>* {
    if (shared) return shared->a.get();
    own = kernels.make(s);
    return own.get();
  };
  int64_t s = begin;
  GivenSample<T> sample{};
  const kernels::Kernel<T>*a = nullptr, *in_system = nullptr;  // of sample s, and the one that the system is made of
  const auto& solver = batch.solver;
  // Goes to the next sample that is to be iterated, and sets its system; false behind the last.
  const auto find_next = [&] {
    for (; s < end; ++s) {
      a = kernel_of(s);
      sample = given_sample(batch, s);
      if (report_if_settled(batch, s, sample, a)) continue;
      if (shared && a == in_system) return true;
      in_system = nullptr;
      if (system.set(*a, solver.preconditioner, shared ? shared->factors : factors_of(*a, solver))) {
        in_system = a;
        return true;
      }
      report(batch, s, zero_instead(SolveStatus::kZeroDiagonal));
    }
    return false;
  };
  if (!find_next()) return;

  auto& workspace = kernels::Workspace<T>::local();
  const int64_t restart = std::min(solver.restart, batch.unknowns);
  const bool starts = batch.x0 != nullptr;
  workspace.prepare(SampleSpace<T>::vectors(starts) + vectors_of(solver.method, restart), a->length(),
                    a->layout().halo);
  SampleSpace<T> space(system, workspace, starts);
  with_method(solver.method, restart, space, [&](auto method) {
    do {
      const auto outcome = solve_sample(space, method, sample);
      report(batch, s, outcome);
      // Whatever a failure left in the padding must not reach the next sample.
      if (is_failure(outcome.status)) space.clear();
      ++s;
    } while (find_next());
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
