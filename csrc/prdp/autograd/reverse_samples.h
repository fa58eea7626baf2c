#pragma once
#include <functional>

#include "prdp/autograd/near_one.h"
#include "prdp/autograd/product_rows.h"
#include "prdp/autograd/run_back.h"
#include "prdp/autograd/sweeps.h"
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
  T* diagonal_bar;  // Jacobi's cotangent of the diagonal; null: not wanted
  int64_t* applications;
  std::function<ProductRows(int64_t sample)> rows;  // for A's gradient; empty: not wanted
  std::function<void(int64_t sample, std::vector<at::Tensor>)> take_gradients;
};

/// The iterates of one sample while its iterations are taken back.
template <class T>
struct KeptIterates {
  KeptIterates(int64_t slots, int64_t vectors_each, int64_t length, int64_t halo)
      : each_(vectors_each), scalars_(kScalars * slots) {
    vectors_.prepare(each_ * slots, length, halo);
  }
  T* vector(int64_t slot, int64_t v) { return vectors_.vector(each_ * slot + v); }
  T& scalar(int64_t slot, int64_t s) { return scalars_[kScalars * slot + s]; }

 private:
  static constexpr int64_t kScalars = 2;  // of a state at most

  int64_t each_;
  kernels::Workspace<T> vectors_;
  std::vector<T> scalars_;
};

/// A sample as a space for sweeps: what methods need, Aᵀ, and where states are kept.
template <class Kernel>
class SweepSpace : public SampleSpace<Kernel> {
  using Base = SampleSpace<Kernel>;

 public:
  using T = typename Kernel::Scalar;

  /// Pairs (λ, v) come out divided by these, as they belong to the scaled sample; no rows: not wanted.
  struct Gradient {
    ProductRows* rows;
    T lambda_scale, v_scale;
  };
  SweepSpace(const Kernel& a, const Kernel& transpose, kernels::Workspace<T>& workspace,
             SampleState& state, KeptIterates<T>& kept, Gradient gradient, bool starts)
      : Base(a, workspace, starts), a_(a), transpose_(transpose), state_(state), kept_(kept), gradient_(gradient) {}

  void axpy(T alpha, const T* x, T* y) { loops_.axpy(alpha, x, y, a_.length()); }
  void apply_transpose(const T* v, T* out) {
    ++state_.applications;
    transpose_.apply(v, out);
  }
  /// out -= t (x - y), by elements.
  void subtract_products(const T* t, const T* x, const T* y, T* out) {
    for (int64_t i = 0; i < a_.length(); ++i) out[i] -= t[i] * (x[i] - y[i]);
  }
  /// Adds sign ∂⟨λ, A v⟩/∂g to A's gradient.
  void differentiate(T sign, const T* lambda, const T* v) {
    if (!gradient_.rows) return;
    a_.store(lambda, sign / gradient_.lambda_scale, gradient_.rows->template lambda<T>());
    a_.store(v, T(1) / gradient_.v_scale, gradient_.rows->template v<T>());
    gradient_.rows->push();
  }

  std::vector<T> copy_of(const T* v) const { return {v, v + a_.length()}; }

  T* slot(int64_t slot, int64_t v) { return kept_.vector(slot, v); }
  T& slot_scalar(int64_t slot, int64_t s) { return kept_.scalar(slot, s); }

 private:
  const kernels::Loops<T>& loops_ = kernels::loops<T>();
  const Kernel &a_, &transpose_;
  SampleState& state_;
  KeptIterates<T>& kept_;
  Gradient gradient_;
};

/// Vectors that a sweep needs beside its method's, x̄ included.
inline int64_t sweep_vectors_of(Method method, int64_t restart) {
  return 6 + (traits(method).counts == Counts::kCycles ? restart : 0);
}

/// Runs the sweep of `method` with x̄ in the vector `x_bar`; returns where b̄ is.
template <class Space, class T>
T* run_sweep(Space& space, T* x_bar, const ReverseBatch<T>& batch, const Checkpoints& plan, double b2,
             T** diagonal_bar) {
  return with_sweep<Space>(batch.method, [&]<class Sweep>(std::type_identity<Sweep>) -> T* {
    Sweep sweep(space, x_bar, {batch.rtol, plan.iterations, b2, batch.restart});
    run_back(sweep, plan);
    if constexpr (requires { sweep.diagonal_bar(); }) *diagonal_bar = sweep.diagonal_bar();
    return sweep.finish();
  });
}

template <class Kernel, class T>
void reverse_sample(const NearOne<Kernel>& near, const Kernel& transpose, kernels::Workspace<T>& workspace,
                    KeptIterates<T>& kept, const ReverseBatch<T>& batch, int64_t s) {
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
  SweepSpace<Kernel> space(a, transpose, workspace, state, kept, {rows ? &*rows : nullptr, lambda_scale, v_scale},
                           batch.x0 != nullptr);
  a.load(b, scale, space.b());
  space.project(space.b());
  space.begin(state);
  const double b2 = space.b2();
  if (batch.x0) space.start_from(batch.x0 + s * n);
  T* x_bar = space.vector();
  a.load(cotangent, bar_scale, x_bar);
  space.project(x_bar);
  T* diagonal_bar = nullptr;
  T* result = run_sweep(space, x_bar, batch, {batch.iterations[s], batch.checkpoint_every}, b2, &diagonal_bar);
  space.project(result);
  if (const T* start = space.started_from()) space.differentiate(-1, result, start);  // r₀ = b - A start
  a.store(result, T(1) / lambda_scale, b_bar);
  if (batch.diagonal_bar) {
    a.store(diagonal_bar, T(1) / lambda_scale, batch.diagonal_bar + s * n);
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
  const int64_t n = a.unknowns(), restart = std::min(batch.restart, n);
  const int64_t most = begin < end ? *std::max_element(batch.iterations + begin, batch.iterations + end) : 0;
  const int64_t state_vectors = with_sweep<SweepSpace<Kernel>>(
      batch.method, []<class Sweep>(std::type_identity<Sweep>) { return Sweep::kStateVectors; });
  KeptIterates<T> kept(Checkpoints(most, batch.checkpoint_every).slots(), state_vectors, a.length(), a.halo());
  const auto reverse = [&](const NearOne<Kernel>& near, const NearOne<Kernel>& transposed, int64_t s) {
    reverse_sample(near, *transposed, workspace, kept, batch, s);
  };
  std::optional<NearOne<Kernel>> shared, shared_transpose;
  if (a.is_shared()) {
    shared.emplace(a);
    shared_transpose.emplace(transpose);
  }
  for (int64_t s = begin; s < end; ++s) {
    // Zeros for the cotangents, and nothing left of a sample before that was not finite.
    workspace.prepare(SweepSpace<Kernel>::vectors(batch.x0 != nullptr) + vectors_of(batch.method, restart) +
                          sweep_vectors_of(batch.method, restart),
                      a.length(), a.halo());
    if (batch.iterations[s] == 0) {
      std::fill_n(batch.b_bar + s * n, n, T(0));
      if (batch.diagonal_bar) std::fill_n(batch.diagonal_bar + s * n, n, T(0));
      batch.applications[s] = 0;
    } else if (shared) {
      reverse(*shared, *shared_transpose, s);
    } else {
      const Kernel own = a.sample(s), own_transpose = transpose.sample(s);
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
void reverse_range(const CsrParameters& a, const CsrParameters& transpose, const ReverseBatch<T>& batch,
                   int64_t begin, int64_t end);
template <class T>
void reverse_range(const BurgersParameters& a, const BurgersParameters& transpose,
                   const ReverseBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void reverse_range(const NavierStokesParameters& a, const NavierStokesParameters& transpose,
                   const ReverseBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void reverse_range(const StencilParameters& a, const StencilParameters& transpose,
                   const ReverseBatch<T>& batch, int64_t begin, int64_t end);

namespace detail {

template <class T, class Parameters>
void reverse_range(const Parameters& a, const Parameters& transpose, const ReverseBatch<T>& batch,
                   int64_t begin, int64_t end) {
  with_kernel<T>(a, [&](const auto& kernel) {
    with_kernel<T>(transpose, [&](const auto& transposed) {
      if constexpr (std::is_same_v<decltype(kernel), decltype(transposed)>)
        reverse_samples(kernel, transposed, batch, begin, end);
    });
  });
}

}  // namespace detail

}  // namespace prdp
