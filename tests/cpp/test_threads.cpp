#include <ATen/Parallel.h>
#include <gtest/gtest.h>
#include <torch/csrc/autograd/autograd.h>

#include <functional>
#include <thread>

#include "helpers.h"
#include "prdp/autograd/linear_solve.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/steppers/steppers.h"
#include "prdp/threads/interruption.h"

/// The loop over the samples of a batch, and callers that solve at the same time. `make sanitize` runs these under
/// ThreadSanitizer.
namespace {

constexpr int kThreads = 4;

/// Sets the number of threads for as long as it lives.
class Threads {
 public:
  explicit Threads(int count) : before_(at::get_num_threads()) { at::set_num_threads(count); }
  ~Threads() { at::set_num_threads(before_); }

 private:
  int before_;
};

using Results = std::vector<at::Tensor>;

/// u, its report and the gradients of u's squares with respect to b and the tensors of A.
Results solved(prdp::OperatorSpec a, const at::Tensor& given, prdp::Solver solver, prdp::Backward backward) {
  const auto b = given.detach().clone().requires_grad_();
  std::vector<at::Tensor> inputs{b};
  for (auto& t : a.tensors) {
    t = t.detach().clone();
    if (t.is_floating_point()) inputs.push_back(t.requires_grad_());
  }
  prdp::SolveOptions options{std::move(solver), backward};
  options.on_failure = prdp::OnFailure::kReturn;
  const auto [u, info] = prdp::linear_solve(a, b, options);
  const auto gradients = torch::autograd::grad({u.square().sum()}, inputs);
  Results all{u.detach(), info.iterations, info.residual, info.status, info.operator_applications};
  all.insert(all.end(), gradients.begin(), gradients.end());
  return all;
}

void expect_equal(const Results& one, const Results& other) {
  ASSERT_EQ(one.size(), other.size());
  for (size_t i = 0; i < one.size(); ++i) EXPECT_TRUE(at::equal(one[i], other[i])) << "result " << i;
}

/// One case for each of the kernels; large enough that the batch is worth several threads.
std::vector<std::pair<prdp::OperatorSpec, at::Tensor>> problems() {
  constexpr int64_t kBatch = 8;
  const auto nu = at::scalar_tensor(1e-2, at::kDouble);
  const auto field = [](std::vector<int64_t> shape) { return prdp_test::random_field(std::move(shape), kBatch); };
  const auto line = field({400}), plane = field({16, 16});
  const auto winds = at::cat({plane, plane.flip({3})}, 1);
  const auto flow = at::cat({winds, at::zeros_like(plane)}, 1);
  const auto b = field({40}).squeeze(1);
  const auto matrix =
      at::rand({40, 40}, at::detail::createCPUGenerator(3), at::kDouble) + 40 * at::eye(40, at::kDouble);
  const auto sparse = matrix.masked_fill(matrix.lt(0.5), 0.0).to_sparse_csr();
  const auto coefficients = at::stack({at::full({16, 16}, 5.0, at::kDouble), -plane[0][0].abs(), -plane[1][0].abs()});
  return {{{"heat", {400}, {1.0}, {nu}}, line},
          {{"poisson", {16, 16}, {}, {}}, plane},
          {{"burgers", {16, 16}, {0.01}, {winds, nu}}, winds},
          {{"navier_stokes", {16, 16}, {0.01}, {flow, nu}}, flow},
          {prdp::stencil(coefficients.unsqueeze(0), {{0, 0}, {0, 1}, {1, 0}}), plane},
          {{"dense", {}, {}, {matrix}}, b},
          {{"csr", {}, {}, {sparse.crow_indices(), sparse.col_indices(), sparse.values()}}, b}};
}

TEST(Threads, TheBatchLoopsGiveTheSameBitsOnOneThreadAndOnMany) {
  const std::vector<prdp::Solver> solvers{prdp::Jacobi{12, 0.0}, prdp::SteepestDescent{12, 0.0}, prdp::CG{12, 0.0},
                                          prdp::GMRES{5, 3, 0.0}, prdp::Direct{}};
  for (const auto& [a, b] : problems())
    for (const auto& solver : solvers) {
      if (a.kind == "navier_stokes" && solver.method == prdp::Method::kJacobi) continue;  // a zero diagonal
      for (const auto backward : {prdp::Backward::kImplicit, prdp::Backward::kUnrolled}) {
        SCOPED_TRACE(testing::Message() << a.kind << " " << name(solver.method) << " " << name(backward));
        const auto on = [&](int threads) {
          const Threads set(threads);
          return solved(a, b, solver, backward);
        };
        expect_equal(on(1), on(kThreads));
      }
    }
}

/// Runs it on several threads at once.
void at_once(const std::function<void(int)>& work) {
  std::vector<std::thread> threads;
  for (int i = 0; i < kThreads; ++i) threads.emplace_back(work, i);
  for (auto& thread : threads) thread.join();
}

TEST(Threads, CallersThatShareAnOperatorDoNotDisturbEachOther) {
  for (const auto& [a, b] : problems()) {
    SCOPED_TRACE(a.kind);
    const auto alone = solved(a, b, prdp::GMRES{5, 4, 0.0}, prdp::Backward::kImplicit);
    std::vector<Results> found(kThreads);
    at_once([&, &a = a, &b = b](int i) { found[i] = solved(a, b, prdp::GMRES{5, 4, 0.0}, prdp::Backward::kImplicit); });
    for (const auto& results : found) expect_equal(results, alone);
  }
}

TEST(Threads, EveryThreadWithAStepperOfItsOwnHasItsOwnReports) {
  const auto u = prdp_test::random_field({30}, 4);
  at_once([&](int i) {
    auto heat = prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{i + 1, 0.0});
    for (int again = 0; again < 20; ++again) {
      heat(u.detach().requires_grad_()).sum().backward();
      EXPECT_TRUE(heat.info()->iterations.eq(i + 1).all().item<bool>());
      EXPECT_TRUE(heat.adjoint_info()->iterations.eq(i + 1).all().item<bool>());
    }
  });
}

TEST(Threads, ALoopThatIsGivenUpStopsOnAllThreads) {
  const Threads set(kThreads);
  std::atomic<int> ended = 0;
  const auto body = [&](int64_t begin, int64_t) {
    if (begin == 0) throw std::runtime_error("given up");
    for (;;) {
      try {
        prdp::interruption::Watch::local().look();
      } catch (const prdp::interruption::Stopped&) {
        ++ended;
        throw;
      }
    }
  };
  EXPECT_THROW(prdp::interruption::parallel_for(0, kThreads, 1, body), std::runtime_error);
  EXPECT_EQ(ended, kThreads - 1);
}

}  // namespace
