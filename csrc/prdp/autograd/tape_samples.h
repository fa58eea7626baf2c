#pragma once
#include <functional>

#include "prdp/autograd/near_one.h"
#include "prdp/autograd/product_rows.h"
#include "prdp/autograd/run_back.h"
#include "prdp/autograd/tape_run.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/sample_space.h"
#include "prdp/solvers/with_kernel.h"

/// The CPU's way back through the iterations of a batch: sample after sample, each to its start.
namespace prdp {

/// b, the start x0, the cotangent and the results as plain arrays: b, x0, the cotangent, b_bar and diagonal_bar
/// contiguous (batch, unknowns), iterations and applications (batch,). Null for x0: all start from zero.
template <class T>
struct ReverseBatch {
  Method method;
  double rtol;
  int64_t restart;
  int64_t checkpoint_every;
  const int64_t* iterations;
  const T* b;
  const T* x0;
  const T* cotangent;
  T* b_bar;
  T* diagonal_bar;  // the cotangent of the diagonal, where the method divides by it; null: not wanted
  int64_t* applications;
  std::function<ProductRows(int64_t sample)> rows;  // for A's gradient; empty: not wanted
  std::function<void(int64_t sample, std::vector<at::Tensor>)> take_gradients;
};

/// Runs the iterations of a sample in `space` and takes them back, from x̄ in memory of the tape; returns where b̄ is.
template <class Kernel, class T>
T* run_and_take_back(Tape<T>& tape, TapeSpace<Kernel>& space, TapeBack<Kernel>& back, KeptStates<T>& kept, T* x_bar,
                     const ReverseBatch<T>& batch, const StoredIterates& plan, double b2) {
  return with_row(batch.method, [&](auto at) -> T* {
    if constexpr (!has_tape(at.row)) {
      TORCH_INTERNAL_ASSERT(false, at.row.name, " is differentiated by autograd alone");
    } else {
      using Run = TapeRun<decltype(at.row.make(space, batch.restart)), Kernel>;
      kept.prepare(plan.slots(), Run::kVectors, Run::kNumbers);
      Run run(tape, space, back, at.row.make(space, batch.restart), kept, x_bar, {batch.rtol, b2});
      run_back(run, plan);
      return run.finish();
    }
  });
}

template <class Kernel, class T>
void reverse_sample(const NearOne<Kernel>& near, const Kernel& transpose, kernels::Workspace<T>& workspace,
                    Tape<T>& tape, KeptStates<T>& kept, const ReverseBatch<T>& batch, int64_t s) {
  const Kernel& a = *near;
  const int64_t n = a.unknowns();
  const T* b = batch.b + s * n;
  const T* cotangent = batch.cotangent + s * n;
  T* b_bar = batch.b_bar + s * n;
  SampleState state;
  const auto scale = kernels::power_of_two_scale(kernels::largest_magnitude(b, n));
  const auto bar_scale = kernels::power_of_two_scale(kernels::largest_magnitude(cotangent, n));
  std::optional<ProductRows> rows;
  if (batch.rows) rows.emplace(batch.rows(s));
  // With A' = factor A and b' = scale b, u = factor/scale u'.
  const T lambda_scale = bar_scale / near.factor(), v_scale = scale / near.factor();
  SampleSpace<Kernel> values(a, workspace, batch.x0 != nullptr);
  a.load(b, scale, values.b());
  values.project(values.b());
  values.begin(state);
  const double b2 = values.b2();
  if (batch.x0) values.start_from(batch.x0 + s * n);
  tape.begin();
  TapeSpace<Kernel> space(tape, values);
  TapeBack<Kernel> back(tape, values, a, transpose, state, space.b().version,
                        {rows ? &*rows : nullptr, lambda_scale, v_scale});
  T* x_bar = tape.new_memory();
  a.load(cotangent, bar_scale, x_bar);
  values.project(x_bar);
  const StoredIterates plan{batch.iterations[s], batch.checkpoint_every};
  T* result = run_and_take_back(tape, space, back, kept, x_bar, batch, plan, b2);
  values.project(result);
  if (const T* start = values.started_from()) back.differentiate(-1, result, start);  // r₀ = b - A start
  a.store(result, T(1) / lambda_scale, b_bar);
  if (batch.diagonal_bar) {
    a.store(back.minus_diagonal_bar(), T(-1) / lambda_scale, batch.diagonal_bar + s * n);
    for (int64_t i = 0; i < n; ++i) batch.diagonal_bar[s * n + i] /= v_scale;
  }
  batch.applications[s] = state.applications;
  if (rows) batch.take_gradients(s, rows->finish());
}

/// Takes the samples [begin, end) back on this thread; those of no iterations get zeros.
template <class Kernel, class T>
void reverse_samples(const Kernel& a, const Kernel& transpose, const ReverseBatch<T>& batch, int64_t begin,
                     int64_t end) {
  auto& workspace = kernels::Workspace<T>::local();
  const int64_t n = a.unknowns();
  Tape<T> tape(a.length(), a.halo());
  KeptStates<T> kept(a.length(), a.halo());
  const auto reverse = [&](const NearOne<Kernel>& near, const NearOne<Kernel>& transposed, int64_t s) {
    reverse_sample(near, *transposed, workspace, tape, kept, batch, s);
  };
  std::optional<NearOne<Kernel>> shared, shared_transpose;
  if (a.is_shared()) {
    shared.emplace(a);
    shared_transpose.emplace(transpose);
  }
  for (int64_t s = begin; s < end; ++s) {
    // Nothing may be left of a sample before that was not finite.
    workspace.prepare(SampleSpace<Kernel>::vectors(batch.x0 != nullptr), a.length(), a.halo());
    if (batch.iterations[s] == 0) {
      std::fill_n(batch.b_bar + s * n, n, T(0));
      if (batch.diagonal_bar) std::fill_n(batch.diagonal_bar + s * n, n, T(0));
      batch.applications[s] = 0;
    } else if (shared) {
      reverse(*shared, *shared_transpose, s);
    } else {
      const Kernel& own = a.sample(s);
      const Kernel& own_transpose = transpose.sample(s);
      reverse(NearOne<Kernel>(own), NearOne<Kernel>(own_transpose), s);
    }
  }
}

/// The same for the operator and its transpose as they are told to the CPU loops; one translation unit a
/// kind of operator.
template <class T>
void reverse_range(const kernels::LaplacianParameters& a, const kernels::LaplacianParameters& transpose,
                   const ReverseBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void reverse_range(const DenseParameters& a, const DenseParameters& transpose, const ReverseBatch<T>& batch,
                   int64_t begin, int64_t end);
template <class T>
void reverse_range(const CsrParameters& a, const CsrParameters& transpose, const ReverseBatch<T>& batch, int64_t begin,
                   int64_t end);
template <class T>
void reverse_range(const BurgersParameters& a, const BurgersParameters& transpose, const ReverseBatch<T>& batch,
                   int64_t begin, int64_t end);
template <class T>
void reverse_range(const NavierStokesParameters& a, const NavierStokesParameters& transpose,
                   const ReverseBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void reverse_range(const StencilParameters& a, const StencilParameters& transpose, const ReverseBatch<T>& batch,
                   int64_t begin, int64_t end);

namespace detail {

template <class T, class Parameters>
void reverse_range(const Parameters& a, const Parameters& transpose, const ReverseBatch<T>& batch, int64_t begin,
                   int64_t end) {
  with_kernel<T>(a, [&](const auto& kernel) {
    with_kernel<T>(transpose, [&](const auto& transposed) {
      if constexpr (std::is_same_v<decltype(kernel), decltype(transposed)>)
        reverse_samples(kernel, transposed, batch, begin, end);
    });
  });
}

}  // namespace detail

}  // namespace prdp
