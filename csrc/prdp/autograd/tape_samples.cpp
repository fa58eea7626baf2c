#include "prdp/autograd/tape_samples.h"

#include "prdp/autograd/stored_iterates.h"
#include "prdp/autograd/tape_run.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/sample_space.h"
#include "prdp/solvers/solve_sample.h"

namespace prdp {

namespace {

/// What the samples of this thread use one after the other.
template <class T>
struct ThreadMemory {
  kernels::Workspace<T>& workspace;
  Tape<T> tape;
  KeptStates<T> kept;
};

/// A and Aᵀ of a sample.
template <class T>
struct SystemWithTranspose {
  SampleSystem<T> system;
  const kernels::Kernel<T>* transpose;
};

/// Runs the iterations of a sample in `space` and takes them back, from x̄ in memory of the tape; returns where b̄ is.
template <class T>
T* run_and_take_back(ThreadMemory<T>& memory, TapeSpace<T>& space, TapeBack<T>& back, T* x_bar, const Solver& solver,
                     const StoredIterates& plan, double b2) {
  return with_row(solver.method, [&](auto at) -> T* {
    if constexpr (!at.row.has_tape) {
      TORCH_INTERNAL_ASSERT(false, at.row.name, " is differentiated by autograd alone");
    } else {
      using Run = TapeRun<decltype(at.row.make(space, solver.restart)), T>;
      memory.kept.prepare(plan.slots(), Run::kVectors, Run::kNumbers);
      Run run(memory.tape, space, back, at.row.make(space, solver.restart), memory.kept, x_bar, {solver.rtol, b2});
      run_back(run, plan);
      return run.finish();
    }
  });
}

template <class T>
void reverse_sample(const SystemWithTranspose<T>& pair, ThreadMemory<T>& memory, const ReverseBatch<T>& batch,
                    int64_t s) {
  const auto& a = pair.system.a();
  const auto& layout = a.layout();
  auto& tape = memory.tape;
  const int64_t n = a.unknowns();
  const T* b = batch.b + s * n;
  const T* cotangent = batch.cotangent + s * n;
  SampleState state;
  const auto scale = kernels::power_of_two_scale(kernels::largest_magnitude(b, n));
  const auto bar_scale = kernels::power_of_two_scale(kernels::largest_magnitude(cotangent, n));
  std::optional<ProductRows> rows;
  if (batch.rows) rows.emplace(batch.rows(s));
  // With A' = factor A and b' = scale b, u = factor/scale u'.
  const T lambda_scale = bar_scale / a.factor(), v_scale = scale / a.factor();
  SampleSpace<T> values(pair.system, memory.workspace, batch.x0 != nullptr);
  values.begin(state);
  values.load(b, scale, values.b());
  values.project(values.b());
  values.take_b();
  const double b2 = values.b2();
  if (batch.x0) start_from(values, batch.x0 + s * n);
  tape.begin();
  TapeSpace<T> space(tape, values);
  TapeBack<T> back(tape, values, a, *pair.transpose, state, space.b().version,
                   {rows ? &*rows : nullptr, lambda_scale, v_scale});
  T* x_bar = tape.new_memory();
  layout.load(cotangent, bar_scale, x_bar);
  values.project_solution(x_bar);
  const StoredIterates plan{batch.iterations[s], batch.checkpoint_every};
  T* result = run_and_take_back(memory, space, back, x_bar, batch.solver, plan, b2);
  values.project(result);
  if (const T* start = values.started_from()) back.differentiate(-1, result, start);  // r₀ = b - A start
  layout.store(result, T(1) / lambda_scale, batch.b_bar + s * n);
  if (batch.diagonal_bar) {
    layout.store(back.minus_diagonal_bar(), T(-1) / lambda_scale, batch.diagonal_bar + s * n);
    for (int64_t i = 0; i < n; ++i) batch.diagonal_bar[s * n + i] /= v_scale;
  }
  batch.applications[s] = state.applications;
  if (rows) batch.take_gradients(s, rows->finish());
}

}  // namespace

template <class T>
void reverse_samples(const kernels::KernelBatch<T>& a, const kernels::KernelBatch<T>& transpose,
                     const ReverseBatch<T>& batch, int64_t unknowns, int64_t begin, int64_t end) {
  std::unique_ptr<kernels::Kernel<T>> own, own_transpose;
  std::optional<ThreadMemory<T>> memory;
  SystemWithTranspose<T> pair;
  for (int64_t s = begin; s < end; ++s) {
    if (batch.iterations[s] > 0 && (!own || !a.is_shared)) {
      own = a.make(s);
      own_transpose = transpose.make(s);
      if (own) pair.system.set(*own, batch.solver.preconditioner, nullptr, own_transpose.get());
      pair.transpose = own_transpose.get();
    }
    if (batch.iterations[s] == 0 || !own) {
      std::fill_n(batch.b_bar + s * unknowns, unknowns, T(0));
      if (batch.diagonal_bar) std::fill_n(batch.diagonal_bar + s * unknowns, unknowns, T(0));
      batch.applications[s] = 0;
      continue;
    }
    const int64_t length = own->length(), halo = own->layout().halo;
    if (!memory) memory.emplace(ThreadMemory<T>{kernels::Workspace<T>::local(), {length, halo}, {length, halo}});
    // The sample before may have left NaN in the workspace.
    memory->workspace.prepare(SampleSpace<T>::vectors(batch.x0 != nullptr), length, halo);
    reverse_sample(pair, *memory, batch, s);
  }
}

template void reverse_samples(const kernels::KernelBatch<float>&, const kernels::KernelBatch<float>&,
                              const ReverseBatch<float>&, int64_t, int64_t, int64_t);
template void reverse_samples(const kernels::KernelBatch<double>&, const kernels::KernelBatch<double>&,
                              const ReverseBatch<double>&, int64_t, int64_t, int64_t);

}  // namespace prdp
