#pragma once
#include "prdp/gpu/device/block_space.h"

/// A solve of a batch in one launch: what solvers/solve_samples.cpp does on the CPU.
namespace prdp::gpu {

/// One sample of a launch.
template <class Space, class Method, class S>
class SampleSolve {
  using T = typename S::T;

 public:
  SampleSolve(const SolveArguments<T>& of, int64_t sample, typename Space::TeamOfSample& team, T* in_block, T* beyond)
      : of_(of),
        sample_(sample),
        team_(team),
        space_(team, typename S::A(of.a, sample), in_block, beyond),
        b_(of.b + sample * Space::unknowns()),
        x0_(of.x0 ? of.x0 + sample * Space::unknowns() : nullptr) {}

  void run() {
    SampleState& state = states_[0];
    state.cap = of_.caps ? of_.caps[sample_] : of_.max_iter;
    space_.begin(state, &of_.null_space, &of_.left_null_space);
    const T magnitude = space_.largest_magnitude(b_);
    if (refused(magnitude)) return;
    const T scale = kernels::power_of_two_scale(magnitude);
    space_.load(b_, scale, space_.b());
    const double rounding = rounding_of_least_numbers<T>(scale, Space::unknowns());
    bool consistent = true;
    if (space_.is_singular()) {
      const T whole = std::sqrt(space_.dot(space_.b(), space_.b()));
      const T outside = space_.project(space_.b());
      consistent = outside <= std::max(consistency_bound<T>(of_.rtol) * whole, static_cast<T>(rounding));
      if (std::sqrt(space_.dot(space_.b(), space_.b())) <= std::numeric_limits<T>::epsilon() * whole)
        return hand_out_zeros(consistent ? SolveStatus::kStagnated : SolveStatus::kInconsistent, 1.0);
    }
    space_.take_b();
    state.b2 = space_.b2();
    state.rounding2 = rounding * rounding;
    if (x0_) start();
    auto method = make();
    iterate(space_, method, states_, of_.rtol, of_.guarded != 0);
    space_.add_start(method.x);
    if (space_.is_singular()) space_.project_solution(method.x);
    if (of_.guarded != 0) excuse_rounding_of_b(state);
    if (!consistent && !is_failure(state.status)) state.status = SolveStatus::kInconsistent;
    hand_out(method.x, scale);
  }

 private:
  Method make() {
    if constexpr (S::kRestart > 0) return Method(space_, S::kRestart);
    else return Method(space_);
  }
  /// Whether it needs no iterations, or gets none.
  bool refused(T magnitude) {
    constexpr double infinity = std::numeric_limits<double>::infinity();
    const auto refuse = [&](SolveStatus status, double residual) {
      hand_out_zeros(status, residual);
      return true;
    };
    if (!std::isfinite(magnitude) || (x0_ && !std::isfinite(space_.largest_magnitude(x0_))))
      return refuse(SolveStatus::kNonfiniteInput, infinity);
    if (!space_.prepare_operator()) return refuse(SolveStatus::kNonfiniteOperator, infinity);
    if constexpr (S::kDividesByDiagonal)
      if (space_.has_zero_diagonal()) return refuse(SolveStatus::kZeroDiagonal, 1.0);
    if (magnitude == T(0)) return refuse(SolveStatus::kConverged, 0.0);
    return false;
  }
  /// From α x0, where α = ⟨b, A x0⟩ / ⟨A x0, A x0⟩ makes the residual least, unless that is no better than zero, or A
  /// x0 is rounding.
  void start() {
    const T magnitude = space_.largest_magnitude(x0_);
    if (magnitude == T(0)) return;
    T *x = space_.start(), *product = space_.scratch(), *r = space_.whole_b();
    space_.load(x0_, kernels::power_of_two_scale(magnitude), x);
    if (space_.is_singular()) {
      const T whole2 = space_.dot(x, x);
      space_.project_solution(x);
      if (leaves_rounding(space_.dot(x, x), whole2, std::numeric_limits<T>::epsilon())) return;
    }
    space_.apply(x, product);
    const T largest = space_.largest_magnitude(product);
    if (!std::isfinite(largest) || !(largest > T(0))) return;
    const T scale = kernels::power_of_two_scale(largest);
    space_.scale(scale, product);
    const T alpha = space_.dot(space_.b(), product) / space_.dot(product, product);
    space_.copy(space_.b(), r);
    space_.axpy(-alpha, product, r);
    space_.scale(scale, x);
    space_.scale(alpha, x);
    const T left2 = space_.dot(r, r);
    const T b2 = space_.b2();
    if (!(left2 < b2) || !std::isfinite(space_.largest_magnitude(x))) return;
    const double size = Space::epsilon() * space_.operator_norm()[0] * std::sqrt(space_.dot(x, x));
    if (left2 <= b2 / 4 || outdoes_rounding<double>(b2, left2, size)) space_.start_here(left2);
  }
  /// With A' = factor A and b' = scale b, u = factor/scale u'.
  void hand_out(T* x, T scale) {
    SampleState& state = states_[0];
    const T before = space_.largest_magnitude(x);
    int exponent = std::ilogb(space_.factor()) - std::ilogb(scale);
    if (std::abs(exponent) > std::numeric_limits<T>::max_exponent - 2) {  // no number of T
      space_.scale(std::ldexp(T(1), exponent / 2), x);
      exponent -= exponent / 2;
    }
    T* const u = of_.u + sample_ * Space::unknowns();
    space_.load(x, std::ldexp(T(1), exponent), u);
    const T largest = space_.largest_magnitude(u);
    if (of_.guarded != 0 && !std::isfinite(largest)) {
      const int64_t applications = state.applications;
      return hand_out_zeros(SolveStatus::kOverflow, 1.0, applications);
    }
    if (before > T(0)) note_underflow<T>(state, static_cast<double>(largest));
    report(state.status, state.iterations, std::sqrt(state.residual2 / state.b2), state.applications,
           std::sqrt(state.floor2 / state.b2));
  }
  void hand_out_zeros(SolveStatus status, double residual, int64_t applications = 0) {
    space_.fill_zero(of_.u + sample_ * Space::unknowns());
    report(status, 0, residual, applications, status == SolveStatus::kStagnated ? residual : 0.0);
  }
  void report(SolveStatus status, int64_t iterations, double residual, int64_t applications, double floor) {
    if (!team_.leads()) return;
    of_.counts[sample_] = iterations;
    of_.counts[of_.batch + sample_] = static_cast<int64_t>(status);
    of_.counts[2 * of_.batch + sample_] = applications;
    of_.reals[sample_] = static_cast<T>(residual);
    of_.reals[of_.batch + sample_] = is_failure(status) ? T(0) : static_cast<T>(floor);
  }

  const SolveArguments<T>& of_;
  int64_t sample_;
  typename Space::TeamOfSample& team_;
  Space space_;
  const T *b_, *x0_;
  std::array<SampleState, 1> states_{};
};

/// The body of a kernel: each team takes one sample after the other.
template <class Method, class S>
void solve_batch(const SolveArguments<typename S::T>& of, typename S::T* in_block) {
  using Space = BlockSpace<S>;
  const int team = static_cast<int>(blockIdx.x) / S::kBlocks, rank = static_cast<int>(blockIdx.x) % S::kBlocks;
  const int64_t beyond_of_team =
      static_cast<int64_t>(S::kVectors - S::kInBlock) * Space::unknowns() + numbers_beyond(S::kRestart);
  typename Space::TeamOfSample threads(rank, of.arrived + 32 * team, of.parts + 2 * kMostAtOnce * S::kBlocks * team);
  for (int64_t sample = team; sample < of.batch; sample += static_cast<int>(gridDim.x) / S::kBlocks)
    SampleSolve<Space, Method, S>(of, sample, threads, in_block, of.memory + beyond_of_team * team).run();
}

}  // namespace prdp::gpu
