/// V-cycles in plain tensor operations, against those of the CPU loops and against what they should do to an error.
#include <gtest/gtest.h>

#include "helpers.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/solvers/tensor_cycles.h"
#include "prdp/solvers/tensor_preconditioner.h"

using namespace prdp;

namespace {

at::Tensor noise(at::IntArrayRef sizes) {
  auto generator = at::detail::createCPUGenerator(3);
  return at::randn(sizes, generator, at::kDouble);
}

at::Tensor vectors(const OperatorSpec& a, int64_t batch, int64_t channels) {
  auto sizes = a.shape;
  sizes.insert(sizes.begin(), {batch, channels});
  return noise(sizes);
}

}  // namespace

TEST(TensorCycles, EqualThoseOfTheLoopsInWindsAndRings) {
  for (const auto& shape : std::vector<std::vector<int64_t>>{{14}, {17}, {8, 11}, {6, 13}}) {
    const auto dim = static_cast<int64_t>(shape.size());
    auto sizes = shape;
    sizes.insert(sizes.begin(), {3, dim});
    const OperatorSpec spec{"burgers", shape, {0.05}, {noise(sizes), at::scalar_tensor(1e-2)}};
    const auto a = make_operator(spec);
    const auto v = vectors(spec, 3, dim);
    const auto loops = make_inverse(*a, Preconditioner::multigrid(), v);
    const TensorCycles cycles(*a, false, kDefaultSmoothing, v);
    EXPECT_TRUE(at::allclose(cycles.apply(v, false), loops(v), 1e-8, 1e-11)) << shape;
  }
}

TEST(TensorCycles, TheTransposeIsTheTranspose) {
  const OperatorSpec spec{"burgers", {8, 11}, {0.05}, {noise({1, 2, 8, 11}), at::scalar_tensor(1e-2)}};
  const auto v = vectors(spec, 2, 2), w = noise({2, 2, 8, 11}).flip(0);
  const TensorCycles cycles(*make_operator(spec), false, 3, v);
  const double left = (cycles.apply(v, false) * w).sum().item<double>();
  EXPECT_NEAR((cycles.apply(w, true) * v).sum().item<double>() / left, 1.0, 1e-11);
}

/// The largest factor by which a cycle contracts an error in the norm of A, of five in a row.
template <class Apply>
double contraction(const Operator& a, at::Tensor x, const Apply& cycle) {
  const auto energy = [&](const at::Tensor& e) { return (e * a.apply(e)).flatten(1).sum(1); };
  double worst = 0.0;
  for (int k = 0; k < 5; ++k) {
    const auto next = x - cycle(a.apply(x));
    worst = std::max(worst, (energy(next) / energy(x)).max().template item<double>());
    x = next;
  }
  return worst;
}

void expect_no_worse_than_loops(const OperatorSpec& spec) {
  const auto a = make_operator(spec);
  const auto x = vectors(spec, 2, 1);
  const TensorCycles cycles(*a, false, kDefaultSmoothing, x);
  const double loops = contraction(*a, x, make_inverse(*a, Preconditioner::multigrid(), x));
  const double tensors = contraction(*a, x, [&](const at::Tensor& r) { return cycles.apply(r, false); });
  EXPECT_LT(loops, 0.9) << spec.shape;
  EXPECT_LT(tensors, std::max(0.1, 1.5 * loops)) << spec.shape;
}

/// At ends with zeros their weights differ a little.
TEST(TensorCycles, ContractAnErrorAboutAsThoseOfTheLoopsDo) {
  for (const auto& shape : std::vector<std::vector<int64_t>>{{7}, {33}, {16, 9}, {12, 31}, {9, 5, 10}, {24, 37}}) {
    expect_no_worse_than_loops({"heat", shape, {0.1}, {at::scalar_tensor(1.0)}});
    auto sizes = shape;
    sizes.insert(sizes.begin(), 2);
    const auto kappa = (3.0 * noise(sizes)).exp();  // from cell to cell, with a contrast of some 10⁸
    expect_no_worse_than_loops(diffusion(kappa, at::scalar_tensor(0.0, at::kDouble)));
  }
}

TEST(TensorCycles, ASampleThatIsNotFiniteStaysAlone) {
  auto kappa = noise({2, 9, 8}).exp();
  const auto v = noise({2, 1, 9, 8});
  const auto shift = at::scalar_tensor(1.0, at::kDouble);
  const auto alone = TensorCycles(*make_operator(diffusion(kappa.narrow(0, 0, 1), shift)), false, 2, v.narrow(0, 0, 1))
                         .apply(v.narrow(0, 0, 1), false);
  kappa.select(0, 1).fill_(std::numeric_limits<double>::infinity());
  const auto both = TensorCycles(*make_operator(diffusion(kappa, shift)), false, 2, v).apply(v, false);
  EXPECT_TRUE(at::allclose(both.narrow(0, 0, 1), alone, 1e-12, 1e-14));
}
