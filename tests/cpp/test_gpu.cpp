#include <gtest/gtest.h>

#include <cstdlib>
#include <locale>

#include "helpers.h"
#include "prdp/autograd/linear_solve.h"
#include "prdp/solvers/solve.h"
#include "prdp/solvers/solve_kernel_text.h"

extern "C" void prdp_fibers_begin(int64_t block_memory, int64_t cells_of_block, int64_t threads, int order,
                                  int left_out, bool poisons, bool captures, int64_t most_blocks, bool from_ptx);
extern "C" void prdp_fibers_end();
extern "C" int64_t prdp_fibers_launches();

/// A program without Python takes kernels; tests in Python say that they are right.
namespace {

TEST(Gpu, ASolveWithItsGradientIsTwoLaunchesWithoutPython) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "kernels are compiled without the sanitizer";
#endif
  const prdp::OperatorSpec heat{"heat", {6, 7}, {1.0}, {at::scalar_tensor(1e-2, at::kDouble)}};
  const auto inverse = at::linalg_inv(at::eye(42, at::kDouble) - 1e-2 * prdp_test::dense_laplacian({6, 7}));
  const auto b = prdp_test::random_field({6, 7}, 3), weights = b.flip(0);
  const auto leaf = b.clone().requires_grad_();

  setenv("PRDP_GPU", "required", 1);
  prdp_fibers_begin(96 << 10, 16384, 64, 0, 0, true, false, 132, false);
  const auto before = prdp_fibers_launches();
  const auto u = prdp::linear_solve(heat, leaf, {prdp::CG{.max_iter = 100, .rtol = 1e-12}}).u;
  EXPECT_STREQ(prdp::way_of_last_solve(), "kernel");
  (u * weights).sum().backward();
  EXPECT_EQ(prdp_fibers_launches() - before, 2);
  prdp_fibers_end();
  unsetenv("PRDP_GPU");

  const auto error = [&](const at::Tensor& found, const at::Tensor& right) {  // A is symmetric
    return (found.detach() - at::matmul(right.flatten(1), inverse).view_as(b)).abs().max().item<double>();
  };
  EXPECT_LT(error(u, b), 1e-10);
  EXPECT_LT(error(leaf.grad(), weights), 1e-10);
}

struct Grouped : std::numpunct<char> {
  char do_thousands_sep() const override { return ','; }
  std::string do_grouping() const override { return "\3"; }
};

TEST(Gpu, TheTextOfAKernelHasNoSeparatorsOfTheUsersLocale) {
  const prdp::gpu::Limits limits{.block_memory = 96 << 10, .cells_of_block = 16384, .threads = 1024, .blocks = 132};
  const auto text = [&] {
    const auto b = at::zeros({1}).expand({2, 1, 1 << 20});
    return prdp::gpu::solve_kernel({.type = "Heat<float>"}, false, prdp::CG{}, b, limits).source.text;
  };
  const auto expected = text();
  const auto before = std::locale::global(std::locale(std::locale::classic(), new Grouped));
  const auto found = text();
  std::locale::global(before);
  EXPECT_EQ(found, expected);
}

/// Kernels count by an int. Up to there a team of all blocks takes any sample, some points a thread.
TEST(Gpu, ASampleThatAKernelCannotCountIsRefusedInWords) {
  const prdp::gpu::Limits limits{.block_memory = 96 << 10, .cells_of_block = 16384, .threads = 1024, .blocks = 132};
  const auto kernel_for = [&](int64_t unknowns) {
    const auto b = at::zeros({1}).expand({2, 1, unknowns});  // without memory
    return prdp::gpu::solve_kernel({.type = "Heat<float>"}, /*is_saddle_point=*/false, prdp::CG{}, b, limits);
  };
  constexpr int64_t most = (int64_t{1} << 30) - 1;
  EXPECT_EQ(kernel_for(most).source.blocks_of_team, 132);
  try {
    kernel_for(most + 1);
    FAIL() << "no refusal";
  } catch (const prdp::gpu::Unavailable& refused) {
    EXPECT_STREQ(refused.what(), "a sample of 1073741824 unknowns is too large for a kernel");
  }
}

}  // namespace
