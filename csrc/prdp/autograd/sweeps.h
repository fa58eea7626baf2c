#pragma once
#include <type_traits>
#include <vector>

#include "prdp/solvers/iterate.h"
#include "prdp/solvers/methods.h"

/// The reverse of one iteration of each method, written out, for one sample in padded memory. A sweep is
/// the method (solvers/) with the cotangents of what an iteration ends with: step_back() takes them to
/// the cotangents of what it starts from, and hands each pair (λ, v) with a share ∂⟨λ, A v⟩ in A's
/// gradient to the space. The space (reverse_samples.h) has Aᵀ and axpy beside what methods need.
namespace prdp {

/// What a sweep is told of the solve: the method's rtol, the iterations that it ran, ‖b‖², and restart.
struct SweepRun {
  double rtol;
  int64_t iterations;
  double b2;
  int64_t restart;
};

/// States of a method in memory of their own: saves and loads what an iteration starts from.
template <class Method, class Space>
class SweepBase : public Method {
 protected:
  using Vector = typename Space::Vector;
  using Scalar = typename Space::Scalar;

 public:
  template <class... Arguments>
  SweepBase(Space& space, Vector x_bar, Arguments... arguments)
      : Method(space, arguments...), sweep_space_(space), x_bar_(x_bar) {}

  /// Vectors that a state is made of.
  static constexpr int64_t kStateVectors = []<class... Part>(std::tuple<Part&...>*) {
    return (int64_t{std::is_same_v<Part, Vector>} + ...);
  }(static_cast<decltype(std::declval<Method&>().carried())*>(nullptr));

  void save(int64_t slot) {
    each([&](auto& part, int64_t v, int64_t s) { put(part, slot, v, s); });
  }
  void load(int64_t slot, int64_t k) {
    each([&](auto& part, int64_t v, int64_t s) { get(part, slot, v, s); });
    this->resume(k);
  }

 protected:
  /// The v-th vector, or the s-th scalar, of the state in a slot.
  const typename Space::T* kept(int64_t slot, int64_t v) const { return sweep_space_.slot(slot, v); }
  Scalar kept_scalar(int64_t slot, int64_t s) const { return sweep_space_.slot_scalar(slot, s); }

  Space& sweep_space_;
  Vector x_bar_;

 private:
  template <class Body>
  void each(const Body& body) {
    int64_t vectors = 0, scalars = 0;
    const auto visit = [&](auto& part) {
      constexpr bool is_vector = std::is_same_v<std::decay_t<decltype(part)>, Vector>;
      body(part, vectors, scalars);
      (is_vector ? vectors : scalars) += 1;
    };
    std::apply([&](auto&... parts) { (visit(parts), ...); }, this->carried());
  }
  void put(Vector& part, int64_t slot, int64_t v, int64_t) {
    sweep_space_.copy(part, sweep_space_.slot(slot, v));
  }
  void put(Scalar& part, int64_t slot, int64_t, int64_t s) { sweep_space_.slot_scalar(slot, s) = part; }
  void get(Vector& part, int64_t slot, int64_t v, int64_t) {
    sweep_space_.copy(sweep_space_.slot(slot, v), part);
  }
  void get(Scalar& part, int64_t slot, int64_t, int64_t s) { part = sweep_space_.slot_scalar(slot, s); }
};

/// A sweep of a method with a residual of its own. Where this claimed convergence and the true one did not,
/// the solve went on from the true one, and so do its iterations here: on the first time through, which has
/// x, they keep what they found for the times after it.
template <class Method, class Space>
class RecursiveSweep : public SweepBase<Method, Space> {
  using Base = SweepBase<Method, Space>;

 public:
  using Vector = typename Space::Vector;
  using Scalar = typename Space::Scalar;

  RecursiveSweep(Space& space, Vector x_bar, SweepRun run)
      : Base(space, x_bar), r_bar_(space.vector()), b_bar_(space.vector()), t_(space.vector()), run_(run) {}

  void start() {
    Method::start();
    done_ = 0;
  }
  void load(int64_t slot, int64_t k) {
    Base::load(slot, k);
    done_ = k;
  }
  void step() {
    Method::step();
    ++done_;
    if (done_ > furthest_) claim();
    else if (const auto* known = correction()) put_back(*known);
    furthest_ = std::max(furthest_, done_);
  }

 protected:
  /// From the cotangent of the residual, all of it in r_bar, to those of x and b: r = P (b - A x). False
  /// where the iteration just run kept its own residual.
  bool correct_back(Scalar norm2_bar) {
    const auto* known = correction();
    if (!known) return false;
    auto& s = this->sweep_space_;
    s.axpy(2 * norm2_bar, known->residual.data(), r_bar_);
    s.project(r_bar_);
    s.axpy(1, r_bar_, b_bar_);
    s.apply_transpose(r_bar_, t_);
    s.axpy(-1, t_, this->x_bar_);
    s.differentiate(-1, r_bar_, known->x.data());
    s.fill_zero(r_bar_);
    return true;
  }

  Vector r_bar_, b_bar_, t_;

 private:
  struct Correction {
    int64_t done;
    Scalar norm2;
    std::vector<Scalar> x, residual;
  };
  void claim() {
    const bool claims = run_.rtol > 0.0 && detail::is_within(this->rr_, run_.rtol, run_.b2);
    if (!claims || done_ == run_.iterations) return;
    this->recompute_residual();
    auto& s = this->sweep_space_;
    corrections_.push_back({done_, this->rr_, s.copy_of(this->x), s.copy_of(this->r_)});
  }
  const Correction* correction() const {
    for (const auto& known : corrections_)
      if (known.done == done_) return &known;
    return nullptr;
  }
  void put_back(const Correction& known) {
    this->sweep_space_.copy(known.residual.data(), this->r_);
    this->go_on_from(known.norm2);
  }

  SweepRun run_;
  int64_t done_ = 0, furthest_ = 0;  // iterations behind the state at hand; and ever
  std::vector<Correction> corrections_;
};

/// One iteration at a time.
template <class Space>
class SingleJacobi : public JacobiMethod<Space> {
 public:
  using JacobiMethod<Space>::JacobiMethod;
  void step() { JacobiMethod<Space>::step(1); }
};

/// x' = x + D⁻¹(b - A x)
template <class Space>
class JacobiSweep : public SweepBase<SingleJacobi<Space>, Space> {
  using Base = SweepBase<SingleJacobi<Space>, Space>;
  using Vector = typename Space::Vector;
  using Base::sweep_space_, Base::x_bar_;

 public:
  JacobiSweep(Space& space, Vector x_bar, SweepRun)
      : Base(space, x_bar), b_bar_(space.vector()), diagonal_bar_(space.vector()), t_(space.vector()),
        product_(space.vector()) {}

  void step_back(int64_t slot, int64_t k) {
    auto& s = sweep_space_;
    const auto* before = this->kept(slot, 0);
    s.divide_by_diagonal(x_bar_, t_);
    s.axpy(1, t_, b_bar_);
    s.subtract_products(t_, this->x, before, diagonal_bar_);  // D⁻¹ r = x' - x
    if (k == 0) return;                                       // x = 0
    s.apply_transpose(t_, product_);
    s.axpy(-1, product_, x_bar_);
    s.differentiate(-1, t_, before);
  }
  Vector finish() { return b_bar_; }
  Vector diagonal_bar() { return diagonal_bar_; }

 private:
  Vector b_bar_, diagonal_bar_, t_, product_;
};

/// q = A r, α = r·r / r·q, x' = x + α r, r' = r - α q
template <class Space>
class SteepestDescentSweep : public RecursiveSweep<SteepestDescentMethod<Space>, Space> {
  using Base = RecursiveSweep<SteepestDescentMethod<Space>, Space>;
  using Vector = typename Space::Vector;
  using Base::sweep_space_, Base::x_bar_, Base::r_bar_, Base::b_bar_, Base::t_, Base::q_, Base::alpha_;

 public:
  SteepestDescentSweep(Space& space, Vector x_bar, SweepRun run)
      : Base(space, x_bar, run), q_bar_(space.vector()) {}

  void step_back(int64_t slot, int64_t) {
    this->correct_back(0);
    if (alpha_ == 0) return;  // it took no step
    auto& s = sweep_space_;
    const auto* r = this->kept(slot, 0);
    const auto rr = this->kept_scalar(slot, 0);
    const auto alpha_bar = s.dot(x_bar_, r) - s.dot(r_bar_, q_);
    const auto rr_bar = alpha_bar * (alpha_ / rr), rq_bar = -alpha_ * rr_bar;
    s.fill_zero(q_bar_);
    s.axpy(-alpha_, r_bar_, q_bar_);
    s.axpy(rq_bar, r, q_bar_);
    s.apply_transpose(q_bar_, t_);
    s.axpy(alpha_, x_bar_, r_bar_);
    s.axpy(2 * rr_bar, r, r_bar_);
    s.axpy(rq_bar, q_, r_bar_);
    s.axpy(1, t_, r_bar_);
    s.differentiate(1, q_bar_, r);
  }
  /// r₀ = b
  Vector finish() {
    sweep_space_.axpy(1, r_bar_, b_bar_);
    return b_bar_;
  }

 private:
  Vector q_bar_;
};

/// q = A p, α = r·r / p·q, x' = x + α p, r' = r - α q, β = r'·r' / r·r, p' = r' + β p
template <class Space>
class ConjugateGradientSweep : public RecursiveSweep<ConjugateGradientMethod<Space>, Space> {
  using Base = RecursiveSweep<ConjugateGradientMethod<Space>, Space>;
  using Vector = typename Space::Vector;
  using Scalar = typename Space::Scalar;
  using Base::sweep_space_, Base::x_bar_, Base::r_bar_, Base::b_bar_, Base::t_;
  using Base::r_, Base::q_, Base::alpha_, Base::beta_;

 public:
  ConjugateGradientSweep(Space& space, Vector x_bar, SweepRun run)
      : Base(space, x_bar, run), p_bar_(space.vector()), q_bar_(space.vector()) {}

  void step_back(int64_t slot, int64_t) {
    auto& s = sweep_space_;
    const auto* p = this->kept(slot, 1);
    const auto rr = this->kept_scalar(slot, 0);
    s.axpy(1, p_bar_, r_bar_);
    if (this->correct_back(rr_bar_)) {  // p = r there
      s.fill_zero(p_bar_);
      rr_bar_ = 0;
    }
    // p' and β; where β or α is 0 the iteration ended there.
    const auto next_rr_bar = beta_ == 0 ? rr_bar_ : rr_bar_ + s.dot(p_bar_, p) / rr;
    rr_bar_ = beta_ == 0 ? Scalar(0) : -beta_ * (s.dot(p_bar_, p) / rr);
    s.axpy(2 * next_rr_bar, r_, r_bar_);
    // r', x' and α
    const bool moved = alpha_ != 0;
    const auto alpha_bar = moved ? s.dot(x_bar_, p) - s.dot(r_bar_, q_) : Scalar(0);
    const auto share = moved ? alpha_bar * (alpha_ / rr) : Scalar(0), pq_bar = -alpha_ * share;
    rr_bar_ += share;
    s.fill_zero(q_bar_);
    s.axpy(-alpha_, r_bar_, q_bar_);
    s.axpy(pq_bar, p, q_bar_);
    s.apply_transpose(q_bar_, t_);
    s.xpby(t_, beta_, p_bar_);
    s.axpy(alpha_, x_bar_, p_bar_);
    s.axpy(pq_bar, q_, p_bar_);
    s.differentiate(1, q_bar_, p);
  }
  /// r₀ = p₀ = b, and r₀·r₀
  Vector finish() {
    for (const auto* share : {r_bar_, p_bar_}) sweep_space_.axpy(1, share, b_bar_);
    sweep_space_.axpy(2 * rr_bar_, sweep_space_.b(), b_bar_);
    return b_bar_;
  }

 private:
  Vector p_bar_, q_bar_;
  Scalar rr_bar_ = 0;
};

/// r = b - A x, v₀ = r/‖r‖, h_{j+1,j} v_{j+1} = A v_j - Σ h_ij v_i, y = argmin ‖r - A V y‖, x' = x + V y.
/// The h are constants, as in gmres.h. With G = (AV)ᵀAV: G dy = d(AV)ᵀ e + (AV)ᵀ(dr - d(AV) y), where
/// e = r - A V y.
template <class Space>
class GmresSweep : public SweepBase<GmresMethod<Space>, Space> {
  using Base = SweepBase<GmresMethod<Space>, Space>;
  using Vector = typename Space::Vector;
  using Scalar = typename Space::Scalar;
  using Base::sweep_space_, Base::x_bar_, Base::v_, Base::y_, Base::columns_;

 public:
  GmresSweep(Space& space, Vector x_bar, SweepRun run)
      : Base(space, x_bar, run.restart, Preconditioner::kNone),
        b_bar_(space.vector()),
        r_bar_(space.vector()),
        e_(space.vector()),
        p_bar_(space.vector()),
        t_(space.vector()) {
    for (int64_t j = 0; j < this->m_; ++j) v_bar_.push_back(space.vector());
  }

  void step() {
    Base::step();
    this->residual2();
  }
  void step_back(int64_t slot, int64_t k) {
    if (this->grew_ != 0) return;  // the cycle was taken back
    auto& s = sweep_space_;
    const int64_t n = columns_;
    const auto* r = this->kept_r_;
    std::vector<Scalar> z(n);
    for (int64_t j = 0; j < n; ++j) {
      z[j] = s.dot(v_[j], x_bar_);
      s.scale(x_bar_, y_[j], v_bar_[j]);
    }
    this->solve_normal(z);
    const auto h = hessenberg();
    combine(h, z, r_bar_);  // A V z
    combine(h, y_, e_);
    s.xpby(r, Scalar(-1), e_);
    for (int64_t j = n - 1; j >= 0; --j) {
      s.scale(e_, z[j], p_bar_);
      s.axpy(-y_[j], r_bar_, p_bar_);
      if (j + 1 < n) {
        const Scalar inverse = 1 / h[j * (n + 1) + j + 1];
        s.axpy(inverse, v_bar_[j + 1], p_bar_);
        for (int64_t i = 0; i <= j; ++i) s.axpy(-h[j * (n + 1) + i] * inverse, v_bar_[j + 1], v_bar_[i]);
      }
      s.apply_transpose(p_bar_, t_);
      s.axpy(1, t_, v_bar_[j]);
      s.differentiate(1, p_bar_, v_[j]);
    }
    const Scalar size = std::sqrt(s.dot(r, r));
    if (size > 0) s.axpy(1 / size, v_bar_[0], r_bar_);
    s.project(r_bar_);
    s.axpy(1, r_bar_, b_bar_);
    if (k == 0) return;  // x = 0
    s.apply_transpose(r_bar_, t_);
    s.axpy(-1, t_, x_bar_);
    s.differentiate(-1, r_bar_, this->kept(slot, 0));
  }
  Vector finish() { return b_bar_; }

 private:
  /// The coefficients by columns of n + 1: R with its rotations undone.
  std::vector<Scalar> hessenberg() {
    const int64_t n = columns_;
    std::vector<Scalar> all(n * (n + 1), Scalar(0));
    for (int64_t j = 0; j < n; ++j) {
      Scalar* column = all.data() + j * (n + 1);
      for (int64_t i = 0; i <= j; ++i) column[i] = this->h(i, j);
      for (int64_t i = j; i >= 0; --i) {
        const Scalar upper = column[i], lower = column[i + 1];
        column[i] = this->cos_[i] * upper - this->sin_[i] * lower;
        column[i + 1] = this->sin_[i] * upper + this->cos_[i] * lower;
      }
    }
    return all;
  }
  /// out = A V w = Σ (H w)_i v_i
  void combine(const std::vector<Scalar>& h, const std::vector<Scalar>& w, Vector out) {
    const int64_t n = columns_;
    sweep_space_.fill_zero(out);
    for (int64_t i = 0; i <= n; ++i) {
      Scalar sum = 0;
      for (int64_t j = std::max<int64_t>(i - 1, 0); j < n; ++j) sum += h[j * (n + 1) + i] * w[j];
      sweep_space_.axpy(sum, v_[i], out);
    }
  }

  Vector b_bar_, r_bar_, e_, p_bar_, t_;
  std::vector<Vector> v_bar_;
};

/// The sweep of a class that iterates; only those named here have one.
template <class Method>
struct SweepOf;
template <class Space>
struct SweepOf<JacobiMethod<Space>> {
  using Type = JacobiSweep<Space>;
};
template <class Space>
struct SweepOf<SteepestDescentMethod<Space>> {
  using Type = SteepestDescentSweep<Space>;
};
template <class Space>
struct SweepOf<ConjugateGradientMethod<Space>> {
  using Type = ConjugateGradientSweep<Space>;
};
template <class Space>
struct SweepOf<GmresMethod<Space>> {
  using Type = GmresSweep<Space>;
};

/// Calls body(std::type_identity<sweep of this method>). A row that promises a sweep which is not written does not
/// compile.
template <class Space, class Body>
auto with_sweep(Method method, const Body& body) {
  using Result = decltype(body(std::type_identity<JacobiSweep<Space>>()));
  return with_row(method, [&](auto at) -> Result {
    if constexpr (at.row.unrolled == Unrolled::kSweep)
      return body(std::type_identity<typename SweepOf<typename std::decay_t<decltype(at.row)>::template In<Space>>::Type>());
    TORCH_INTERNAL_ASSERT(at.row.unrolled == Unrolled::kSweep, "no reverse is written for ", at.row.name);
    return Result();
  });
}

}  // namespace prdp
