#include <gtest/gtest.h>
#include <torch/torch.h>

#include <array>
#include <cmath>
#include <deque>
#include <limits>
#include <vector>

#include "prdp/autograd/linear_solve.h"
#include "prdp/operators/kinds.h"
#include "prdp/solvers/bicgstab.h"
#include "prdp/solvers/conjugate_gradient.h"
#include "prdp/solvers/iterate.h"
#include "prdp/solvers/sample_numbers.h"
#include "prdp/solvers/tensor_space.h"

namespace prdp {

namespace {

/// A place with the primitives alone: the rest comes from SpaceDefaults. A is dense.
class PlainSpace : public SampleNumbers<double>, public SpaceDefaults<PlainSpace> {
 public:
  using Vector = double*;
  using Scalar = double;
  using States = std::array<SampleState, 1>;

  PlainSpace(at::Tensor a, const at::Tensor& b, SampleState& state) : a_(std::move(a)), state_(state) {
    const auto* values = b.const_data_ptr<double>();
    std::copy(values, values + unknowns(), b_ = vector());
  }

  Vector vector() { return memory_.emplace_back(unknowns(), 0.0).data(); }
  Vector scratch() { return vector(); }
  Vector b() const { return b_; }
  Scalar b2() const { return dot(b_, b_); }
  int64_t unknowns() const { return a_.size(0); }
  void fill_zero(Vector x) { std::fill_n(x, unknowns(), 0.0); }
  void copy(const double* x, Vector y) { std::copy_n(x, unknowns(), y); }
  void advance(Vector& x, Vector& y) { std::swap(x, y); }
  void add(const double* x, Vector y) { xpby(x, 1.0, y); }
  void xpby(const double* x, Scalar beta, Vector y) {
    for (int64_t i = 0; i < unknowns(); ++i) y[i] = x[i] + beta * y[i];
  }
  Scalar dot(const double* x, const double* y) const {
    double sum = 0.0;
    for (int64_t i = 0; i < unknowns(); ++i) sum += x[i] * y[i];
    return sum;
  }
  Scalar update_iterate_and_residual(Scalar alpha, const double* p, const double* q, Vector x, Vector r) {
    for (int64_t i = 0; i < unknowns(); ++i) x[i] += alpha * p[i], r[i] -= alpha * q[i];
    return dot(r, r);
  }
  void apply(const double* x, Vector y) {
    ++state_.applications;
    for (int64_t i = 0; i < unknowns(); ++i) y[i] = dot(a_.const_data_ptr<double>() + i * unknowns(), x);
  }
  Scalar residual(const double* x, Vector r) {
    apply(x, r);
    xpby(b_, -1.0, r);
    return dot(r, r);
  }
  Scalar precondition(const double* x, Vector y) {
    copy(x, y);
    return dot(x, y);
  }
  static bool is_preconditioned() { return false; }
  using SampleNumbers<double>::restore;
  void restore(Scalar where, const double* x, Vector y) {
    if (where != 0.0) copy(x, y);
  }

  std::array<double, 1> values_of(double a) const { return {a}; }
  std::array<bool, 1> broken() const { return {broken_}; }
  std::array<double, 1> operator_norm() const { return {a_.abs().sum(1).max().item<double>()}; }
  std::array<bool, 1> surely_definite() const { return {false}; }
  Scalar solution2(const double* x) const { return dot(x, x); }
  Scalar componentwise_scale2(const double* x, int64_t) const { return dot(x, x); }
  template <class Wanted>
  void freeze_unless(const States&, const Wanted&) {}
  template <class Function>
  auto map(const States& states, const Function& f) const {
    return std::array{f(states[0])};
  }
  Vector select(const std::array<bool, 1>&, Vector, Vector x) const { return x; }
  void reset() { broken_ = false; }

 private:
  at::Tensor a_;
  SampleState& state_;
  std::deque<std::vector<double>> memory_;
  Vector b_ = nullptr;
};

static_assert(VectorSpace<PlainSpace> && LoopSpace<PlainSpace>);

template <template <VectorSpace> class Method>
void expect_solves(const at::Tensor& a) {
  const auto b = torch::linspace(-1.0, 2.0, a.size(0), torch::kDouble);
  PlainSpace::States states{};
  states[0].cap = 40;
  PlainSpace space(a, b, states[0]);
  states[0].b2 = space.b2();
  Method<PlainSpace> method(space);
  iterate(space, method, states, /*rtol=*/1e-12, /*guarded=*/true);
  EXPECT_EQ(states[0].status, SolveStatus::kConverged);
  EXPECT_LE(states[0].iterations, 8);
  const auto u = torch::from_blob(method.x, {a.size(0)}, torch::kDouble);
  const at::Tensor off = u - torch::linalg_solve(a, b);
  EXPECT_LT(off.abs().max().item<double>(), 1e-11);
}

TEST(Space, AMethodRunsOnThePrimitivesAlone) {
  torch::manual_seed(0);
  const auto shift = 4.0 * torch::eye(6, torch::kDouble), random = torch::rand({6, 6}, torch::kDouble);
  expect_solves<ConjugateGradientMethod>(shift + random + random.t());
  expect_solves<BiCGStabMethod>(shift + random);
}

}  // namespace

TEST(TensorSpace, QuotientsTellBreakdownsAsThoseOfOneSample) {
  constexpr double inf = std::numeric_limits<double>::infinity(), nan = std::numeric_limits<double>::quiet_NaN();
  std::vector<std::array<double, 4>> cases;  // num, den, a², b²
  for (const double num : {0.0, 1.0, -1.0})
    for (const double den : {0.0, 1e-20, 2.0, inf, nan})
      for (const double a2 : {1.0, inf})
        for (const double b2 : {1.0, inf, nan})
          if (den != inf || a2 != inf)  // a product that no direction has
            cases.push_back({num, den, a2, b2});
  const auto samples = static_cast<int64_t>(cases.size());
  const auto column = [&](size_t k) {
    std::vector<double> of_all;
    for (const auto& numbers : cases) of_all.push_back(numbers[k]);
    return at::tensor(of_all, at::kDouble).view({samples, 1});
  };
  const auto a = make_operator(matrix(at::eye(16, at::kDouble)));
  const Preconditioner none;
  for (const bool recording : {false, true}) {
    std::vector<SampleState> states(cases.size());
    TensorSpace::System system{*a, none};
    TensorSpace space(system, at::ones({samples, 16}, at::kDouble), states, recording);
    const auto found = space.values_of(space.guarded_quotient(column(0), column(1), column(2), column(3)));
    const auto broken = space.broken();
    for (size_t i = 0; i < cases.size(); ++i) {
      const auto& [num, den, a2, b2] = cases[i];
      bool breaks = false;
      const double wanted = SampleNumbers<double>::guarded_quotient(num, den, a2, b2, breaks);
      EXPECT_EQ(broken[i], breaks) << (recording ? "recorded, " : "") << num << " / " << den << ", " << a2 << ", "
                                   << b2;
      EXPECT_TRUE(found[i] == wanted || (std::isnan(found[i]) && std::isnan(wanted)))
          << found[i] << ", not " << wanted << " of " << num << " / " << den << ", " << a2 << ", " << b2;
    }
  }
}

}  // namespace prdp
