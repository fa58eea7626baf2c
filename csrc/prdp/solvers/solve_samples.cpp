#include "prdp/solvers/solve_samples.h"

#include <cmath>
#include <limits>

#include "prdp/solvers/methods.h"
#include "prdp/solvers/sample_space.h"

namespace prdp {

namespace {

template <class T>
void report(const SampleBatch<T>& batch, int64_t s, SolveStatus status, int64_t iterations, double residual,
            int64_t applications, double floor = 0.0) {
  batch.status[s] = static_cast<int64_t>(status);
  batch.iterations[s] = iterations;
  batch.residual[s] = static_cast<T>(residual);
  batch.applications[s] = applications;
  batch.floor[s] = is_failure(status) ? T(0) : static_cast<T>(floor);
}

template <class T>
void hand_out_zeros(const SampleBatch<T>& batch, int64_t s, SolveStatus status, double residual,
                    int64_t applications = 0) {
  std::fill_n(batch.u + s * batch.unknowns, batch.unknowns, T(0));
  report(batch, s, status, 0, residual, applications, status == SolveStatus::kStagnated ? residual : 0.0);
}

template <class T>
const T* start_of(const SampleBatch<T>& batch, int64_t s) {
  return traits(batch.solver.method).is_direct || !batch.x0 ? nullptr : batch.x0 + s * batch.unknowns;
}

/// Reports on a sample that needs no iterations, or gets none; returns false for all others. Without a kernel, A is not
/// finite.
template <class T>
bool settled_beforehand(const SampleBatch<T>& batch, int64_t s, const kernels::Kernel<T>* a) {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  const T magnitude = kernels::largest_magnitude(batch.b + s * batch.unknowns, batch.unknowns);
  const T* x0 = start_of(batch, s);
  const auto refuse = [&](SolveStatus status, double residual) {
    hand_out_zeros(batch, s, status, residual);
    return true;
  };
  if (!std::isfinite(magnitude) || (x0 && !std::isfinite(kernels::largest_magnitude(x0, batch.unknowns))))
    return refuse(SolveStatus::kNonfiniteInput, infinity);
  if (!a) return refuse(SolveStatus::kNonfiniteOperator, infinity);
  if (divides_by_diagonal(batch.solver) && a->has_zero_diagonal()) return refuse(SolveStatus::kZeroDiagonal, 1.0);
  if (magnitude == T(0)) return refuse(SolveStatus::kConverged, 0.0);
  return false;
}

/// Stores 2^exponent x and returns the largest magnitude, which is not finite if a number leaves the range of T.
template <class T>
T store_scaled(const kernels::Kernel<T>& a, int exponent, T* x, T* u) {
  int in_place = 0;
  if (std::abs(exponent) > std::numeric_limits<T>::max_exponent - 2) {  // no number of T
    in_place = exponent / 2;
    kernels::WholeVectors<T>().scale(std::ldexp(T(1), in_place), x, x, a.length());
  }
  a.layout().store(x, std::ldexp(T(1), exponent - in_place), u);
  return kernels::largest_magnitude(u, a.unknowns());
}

/// Solves a sample. b is scaled by a power of two to the order of one, so that no square over- or
/// underflows and solve(2^k b) = 2^k solve(b) holds to the last bit.
template <class Iteration, class T>
void solve_sample(const kernels::Kernel<T>& a, SampleSpace<T>& space, Iteration& method, const SampleBatch<T>& batch,
                  int64_t s) {
  std::array<SampleState, 1> states;
  SampleState& state = states[0];
  state.cap = batch.caps ? batch.caps[s] : batch.max_iter;
  const T* b = batch.b + s * batch.unknowns;
  const T scale = kernels::power_of_two_scale(kernels::largest_magnitude(b, batch.unknowns));
  a.layout().load(b, scale, space.b());
  const double rounding = rounding_of_least_numbers<T>(scale, batch.unknowns);
  bool consistent = true;
  if (const auto& null_space = a.left_null_space()) {
    const T whole = std::sqrt(space.dot(space.b(), space.b()));
    const T outside = null_space->project(space.b());
    consistent = outside <= std::max(consistency_bound<T>(batch.solver.rtol) * whole, static_cast<T>(rounding));
    if (std::sqrt(space.dot(space.b(), space.b())) <= std::numeric_limits<T>::epsilon() * whole)
      return hand_out_zeros(batch, s, consistent ? SolveStatus::kStagnated : SolveStatus::kInconsistent, 1.0);
  }
  space.begin(state);
  state.b2 = space.b2();
  state.rounding2 = rounding * rounding;
  if (const T* x0 = start_of(batch, s)) space.start_from(x0);
  iterate(space, method, states, batch.solver.rtol, batch.guarded);
  space.add_start(method.x);
  space.project_solution(method.x);
  if (batch.guarded) excuse_rounding_of_b(state);
  if (!consistent && !is_failure(state.status)) state.status = SolveStatus::kInconsistent;
  // With A' = factor A and b' = scale b, u = factor/scale u'.
  const T largest = store_scaled(a, std::ilogb(a.factor()) - std::ilogb(scale), method.x, batch.u + s * batch.unknowns);
  if (batch.guarded && !std::isfinite(largest)) {
    hand_out_zeros(batch, s, SolveStatus::kOverflow, 1.0, state.applications);
  } else {
    const bool tiny = largest < std::numeric_limits<T>::min();
    if (tiny && kernels::WholeVectors<T>().largest_magnitude(method.x, a.length()) > T(0))
      note_underflow<T>(state, static_cast<double>(largest));
    report(batch, s, state.status, state.iterations, std::sqrt(state.residual2 / state.b2), state.applications,
           std::sqrt(state.floor2 / state.b2));
  }
  // Whatever a failure left in the padding must not reach the next sample.
  if (is_failure(static_cast<SolveStatus>(batch.status[s]))) space.clear();
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
  const kernels::Kernel<T>*a = nullptr, *set = nullptr;  // of sample s, and the one that the system is made of
  const auto& solver = batch.solver;
  // Goes to the next sample that is to be iterated, and sets its system; false behind the last.
  const auto find_next = [&] {
    for (; s < end; ++s) {
      a = kernel_of(s);
      if (settled_beforehand(batch, s, a)) continue;
      if (shared && a == set) return true;
      set = nullptr;
      if (system.set(*a, solver.preconditioner, shared ? shared->factors : factors_of(*a, solver))) {
        set = a;
        return true;
      }
      hand_out_zeros(batch, s, SolveStatus::kZeroDiagonal, 1.0);
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
      solve_sample(*a, space, method, batch, s);
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
