#include <gtest/gtest.h>
#include <torch/csrc/autograd/forward_grad.h>

#include "helpers.h"
#include "prdp/prdp.h"

namespace {

using torch::autograd::ForwardADLevel;

/// Forward mode, as torch.autograd.forward_ad.dual_level() of Python.
class DualLevel {
 public:
  DualLevel() : level_(ForwardADLevel::get_next_idx()) {}
  DualLevel(const DualLevel&) = delete;
  ~DualLevel() { ForwardADLevel::release_idx(level_); }
  at::Tensor dual(const at::Tensor& primal, const at::Tensor& tangent) const {
    return at::_make_dual(primal, tangent, static_cast<int64_t>(level_));
  }
  at::Tensor tangent(const at::Tensor& t) const {
    return std::get<1>(at::_unpack_dual(t, static_cast<int64_t>(level_)));
  }

 private:
  uint64_t level_;
};

TEST(ForwardMode, TheTangentOfASolveIsASolve) {
  at::manual_seed(0);
  const auto a = at::randn({5, 5}, at::kDouble) + 5 * at::eye(5, at::kDouble);
  const auto b = at::randn({2, 5}, at::kDouble), da = at::randn_like(a), db = at::randn_like(b);
  const DualLevel level;
  const auto solved = prdp::linear_solve(prdp::matrix(level.dual(a, da)), level.dual(b, db),
                                         {prdp::GMRES{.restart = 5, .max_iter = 9, .rtol = 1e-14}});
  const auto u = at::linalg_solve(a, b.mT());
  const auto expected = at::linalg_solve(a, db.mT() - at::matmul(da, u)).mT();
  EXPECT_LT((level.tangent(solved.u) - expected).abs().max().item<double>(), 1e-12);
}

TEST(ForwardMode, StepsAndRolloutsCarryTangentsInBothModes) {
  const auto u = prdp_test::random_field({6}, 2), du = prdp_test::random_field({6}, 2).flip(0);
  const auto nu = at::scalar_tensor(1e-2, at::kDouble), dnu = at::scalar_tensor(0.7, at::kDouble);
  for (const auto mode : {prdp::Backward::kImplicit, prdp::Backward::kUnrolled}) {
    const auto end = [&](const at::Tensor& state, const at::Tensor& viscosity) {
      prdp::Burgers step({6}, viscosity, 0.1, prdp::GMRES{.restart = 6, .max_iter = 9, .rtol = 1e-14}, mode);
      return step.rollout(step(state), 2).select(1, 2);
    };
    constexpr double h = 1e-6;
    const auto expected = (end(u + h * du, nu + h * dnu) - end(u - h * du, nu - h * dnu)) / (2 * h);
    const DualLevel level;
    const auto tangent = level.tangent(end(level.dual(u, du), level.dual(nu, dnu)));
    ASSERT_TRUE(tangent.defined());
    EXPECT_LT((tangent - expected).abs().max().item<double>(), 1e-7);
  }
}

}  // namespace
