#include <gtest/gtest.h>
#include <torch/csrc/autograd/autograd.h>

#include "helpers.h"
#include "prdp/autograd/linear_solve.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/function_operator.h"
#include "prdp/operators/operator.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/solvers/solve.h"
#include "prdp/threads/interruption.h"

/// The CPU loops against the plain-tensor solver, which share only the text of the methods.
namespace {

using prdp::Method;

using prdp::Preconditioner;
using prdp::Solver;

const std::vector<std::pair<Solver, const char*>> kSolvers{
    {{Method::kJacobi, 0}, "jacobi"},
    {{Method::kSteepestDescent, 0}, "steepest_descent"},
    {{Method::kConjugateGradient, 0}, "cg"},
    {prdp::CG{.max_iter = 0, .preconditioner = Preconditioner::diagonal()}, "cg, diagonal"},
    {{Method::kDirect, 0}, "direct"}};

Solver with(Solver solver, int64_t max_iter, double rtol) {
  solver.max_iter = max_iter;
  solver.rtol = rtol;
  return solver;
}

prdp::OperatorSpec heat(std::vector<int64_t> shape) {
  return {"heat", std::move(shape), {1.0}, {at::scalar_tensor(1e-3, at::kDouble)}};
}

void expect_same(const prdp::OperatorSpec& spec, const at::Tensor& b, const prdp::SolveRequest& request,
                 double tolerance) {
  const auto a = prdp::make_operator(spec);
  const auto loops = prdp::solve(*a, b, request), tensors = prdp::solve_with_tensors(*a, b, request);
  const double scale = tensors.u.abs().max().item<double>() + 1e-300;
  EXPECT_LT((loops.u - tensors.u).abs().max().item<double>(), tolerance * scale);
  EXPECT_TRUE(at::equal(loops.info.iterations, tensors.info.iterations));
  // Without a tolerance, converged means a residual of exactly zero: a matter of the last bit.
  if (request.solver.rtol > 0.0) {
    EXPECT_TRUE(at::equal(loops.info.status, tensors.info.status));
  }
  EXPECT_TRUE(at::equal(loops.info.operator_applications, tensors.info.operator_applications));
}

TEST(Solve, LoopsEqualPlainTensorsAtSizesAroundTheVectorWidth) {
  const std::vector<std::vector<int64_t>> shapes{{1},    {2},     {7},     {8},     {15},    {16},      {17},     {33},
                                                 {1, 1}, {5, 16}, {16, 5}, {31, 9}, {1, 17}, {2, 3, 4}, {7, 1, 9}};
  for (const auto& shape : shapes)
    for (const auto& [solver, name] : kSolvers) {
      SCOPED_TRACE(testing::Message() << name << " " << at::IntArrayRef(shape));
      const auto b = prdp_test::random_field(shape, 4);
      const int64_t k = solver.method == Method::kDirect ? 1 : 3;
      expect_same(heat(shape), b, {with(solver, k, 0.0)}, 1e-13);
      expect_same(heat(shape), b.to(at::kFloat), {with(solver, k, 0.0)}, 2e-6);
    }
}

TEST(Solve, LoopsEqualPlainTensorsUpToTheSameStop) {
  for (const auto& [solver, name] : kSolvers) {
    SCOPED_TRACE(name);
    expect_same(heat({30}), prdp_test::random_field({30}, 5), {with(solver, 200, 1e-8)}, 1e-9);
    expect_same(heat({12, 9}), prdp_test::random_field({12, 9}, 5), {with(solver, 200, 1e-8)}, 1e-9);
  }
}

TEST(Solve, EachSampleStopsAtItsOwnCap) {
  const auto a = prdp::make_operator(heat({20}));
  const auto b = prdp_test::random_field({20}, 4);
  const auto caps = at::tensor({0, 1, 5, 9}, at::kLong);
  for (const auto& [solver, name] : kSolvers) {
    SCOPED_TRACE(name);
    const prdp::SolveRequest request{with(solver, 99, 0.0), caps};
    for (const auto& result : {prdp::solve(*a, b, request), prdp::solve_with_tensors(*a, b, request)}) {
      EXPECT_TRUE(at::equal(result.info.iterations, caps));
      for (int64_t i = 0; i < 4; ++i) {
        const auto alone = prdp::solve(*a, b.narrow(0, i, 1), {with(solver, caps[i].item<int64_t>(), 0.0)});
        EXPECT_LT((alone.u[0] - result.u[i]).abs().max().item<double>(), 1e-13);
      }
    }
  }
}

TEST(Solve, CountsProductsWithTheOperator) {
  const auto a = prdp::make_operator(heat({20}));
  const auto b = prdp_test::random_field({20}, 1);
  const auto products = [&](Method method, int64_t k, double rtol) {
    return prdp::solve(*a, b, {{method, k, rtol}}).info.operator_applications[0].item<int64_t>();
  };
  // From zero the first Jacobi iterate is free, and each solve ends with its true residual.
  EXPECT_EQ(products(Method::kJacobi, 10, 0.0), 10);
  EXPECT_EQ(products(Method::kSteepestDescent, 10, 0.0), 11);
  EXPECT_EQ(products(Method::kConjugateGradient, 10, 0.0), 11);
  EXPECT_EQ(products(Method::kDirect, 1, 0.0), 1);
  EXPECT_EQ(products(Method::kJacobi, 10, 1e-30), 11);
}

TEST(Solve, APreconditionerIsRefusedByMethodsThatTakeNone) {
  const auto a = heat({20});
  const auto b = prdp_test::random_field({20}, 1);
  Solver solver = prdp::Jacobi{.max_iter = 3};
  solver.preconditioner = Preconditioner::diagonal();
  EXPECT_THROW(prdp::linear_solve(a, b, {solver}), c10::ValueError);
}

TEST(Solve, AnOperatorOfOnesOwnPreconditions) {
  // One iteration is enough where M is A itself.
  const auto a = heat({20});
  const auto b = prdp_test::random_field({20}, 2);
  EXPECT_THROW(prdp::RegisteredProducts::make({}), c10::ValueError);
  const auto products = prdp::RegisteredProducts::make({[&](const at::Tensor& v, const std::vector<at::Tensor>&) {
                                                          return prdp::make_operator(a)->solve_directly(v, false);
                                                        },
                                                        [&](const at::Tensor& v, const std::vector<at::Tensor>&) {
                                                          return prdp::make_operator(a)->solve_directly(v, false);
                                                        }});
  const Preconditioner inverse = products->spec({});
  for (const Solver& solver :
       {Solver(prdp::CG{.max_iter = 1, .rtol = 1e-10, .preconditioner = inverse}),
        Solver(prdp::BiCGStab{.max_iter = 1, .rtol = 1e-10, .preconditioner = inverse}),
        Solver(prdp::GMRES{.restart = 1, .max_iter = 1, .rtol = 1e-10, .preconditioner = inverse})})
    EXPECT_TRUE((prdp::linear_solve(a, b, {solver}).info.status > 0).all().item<bool>());
}

TEST(Solve, AFailedSampleLeavesNothingBehindForTheNextOne) {
  // Diverges on the first matrix; the second, solved in the same memory, must not see it.
  auto first = at::full({3, 3}, 0.9, at::kDouble);
  first.diagonal().fill_(1.0);
  const auto matrices = at::stack({first, at::eye(3, at::kDouble) * 2.0, first, at::eye(3, at::kDouble) * 4.0});
  const auto a = prdp::make_operator({"dense", {}, {}, {matrices}});
  const auto b = at::ones({4, 3}, at::kDouble);
  const auto result = prdp::solve(*a, b, {{Method::kJacobi, 500, 0.0}});
  EXPECT_EQ(result.info.status[0].item<int64_t>(), -3);
  EXPECT_TRUE(result.u.isfinite().all().item<bool>());
  EXPECT_TRUE(result.u[1].eq(0.5).all().item<bool>());
  EXPECT_TRUE(result.u[3].eq(0.25).all().item<bool>());
}

TEST(Solve, AnInterruptionEndsAllThreadsAndLeavesNothingBehind) {
  struct Interrupted {};
  const auto a = prdp::make_operator(heat({64, 64}));
  const auto b = at::randn({16, 1, 64, 64}, at::kDouble);
  const prdp::SolveRequest request{{Method::kConjugateGradient, 200, 1e-10}};
  const auto wanted = prdp::solve(*a, b, request).u;
  prdp::interruption::set_check([] { throw Interrupted{}; });
  for (const auto method : {Method::kJacobi, Method::kConjugateGradient})
    EXPECT_THROW(prdp::solve(*a, b, {{method, int64_t{1} << 50, 0.0}}), Interrupted);
  prdp::interruption::set_check(nullptr);
  EXPECT_TRUE(at::equal(prdp::solve(*a, b, request).u, wanted));

  // The other threads end although nobody interrupts them, and the first error comes out.
  const auto body = [](int64_t begin, int64_t) {
    if (begin == 0) throw Interrupted{};
    for (;;) prdp::interruption::Watch::local().look();
  };
  EXPECT_THROW(prdp::interruption::parallel_for(0, 8, 1, body), Interrupted);
}

TEST(Matrix, OnlySquareOnesWithIndicesInRangeAreTaken) {
  const auto eye = at::eye(3, at::kDouble);
  EXPECT_NO_THROW(prdp::matrix(eye.to_sparse_csr()));
  EXPECT_THROW(prdp::matrix(at::ones({3, 4})), c10::ValueError);
  EXPECT_THROW(prdp::matrix(at::ones({3, 4}).to_sparse_csr()), c10::ValueError);
  EXPECT_THROW(prdp::matrix(at::ones({3})), c10::ValueError);
  EXPECT_THROW(prdp::matrix(eye.to_sparse()), c10::ValueError);
  const auto b = at::ones({2, 3}, at::kDouble);
  const prdp::SolveOptions options{prdp::CG{.max_iter = 5}};
  EXPECT_TRUE(at::allclose(prdp::linear_solve(prdp::matrix(eye.to_sparse_csr()), b, options).u, b));
  EXPECT_THROW(prdp::linear_solve(prdp::matrix(eye), eye.to_sparse(), options), c10::ValueError);
  auto spoilt = prdp::matrix(eye.to_sparse_csr());
  spoilt.tensors[1] = at::tensor({0, 1, 3}, at::kLong);
  EXPECT_THROW(prdp::linear_solve(spoilt, b, options), c10::ValueError);
  EXPECT_THROW(prdp::linear_solve(prdp::matrix(at::eye(0)), at::ones({2, 0}), options), c10::ValueError);
}

TEST(Solve, EmptyBatchIsNoTrouble) {
  const auto a = prdp::make_operator(heat({20}));
  const auto result = prdp::solve(*a, at::zeros({0, 1, 20}), {{Method::kJacobi, 3, 1e-5}});
  EXPECT_EQ(result.u.size(0), 0);
  EXPECT_EQ(result.info.status.numel(), 0);
}

TEST(Solve, NullVectorsOfAllChannelsAreThoseOfAPressureAlone) {
  // (2 u + ∂ᵀp, ∂u) on a periodic line, which forgets the mean of p.
  const int64_t n = 8;
  const auto products =
      prdp::RegisteredProducts::make({.apply = [](const at::Tensor& v, const std::vector<at::Tensor>&) {
        const auto u = v.select(1, 0), p = v.select(1, 1);
        return at::stack({2 * u + at::roll(p, 1, 1) - p, at::roll(u, -1, 1) - u}, 1);
      }});
  const auto of_pressure = at::stack({at::zeros({n}, at::kDouble), at::ones({n}, at::kDouble)}).unsqueeze(0);
  const auto a = prdp::with_null_space(products->spec({}), of_pressure);
  auto b = prdp_test::random_field({2, n}, 3).view({3, 2, n});
  b.select(1, 1) -= b.select(1, 1).mean(-1, /*keepdim=*/true);
  for (const Solver& solver :
       {Solver(prdp::GMRES{.restart = 20, .max_iter = 5, .rtol = 1e-12}), Solver(prdp::Direct{})}) {
    const auto u = prdp::linear_solve(a, b, {solver}).u;
    EXPECT_TRUE(at::allclose(products->products().apply(u, {}), b, 1e-9, 1e-9));
    EXPECT_LT(u.select(1, 1).mean(-1).abs().max().item<double>(), 1e-12);
    EXPECT_GT(u.select(1, 0).mean(-1).abs().max().item<double>(), 1e-3);
  }
}

TEST(Diffusion, RobinSidesStandInSeriesWithHalfACell) {
  using prdp::Side;
  const auto options = at::TensorOptions(at::kDouble);
  const auto kappa = at::full({1, 1}, 2.0, options), number = at::full({}, 4.0, options).requires_grad_();
  const auto field = at::full({1}, 4.0, options).requires_grad_();
  // The cell has width 1: half of it conducts by 4, and a side with h = 4 halves that. With shift 1, A is 1 + 2 · 2.
  const auto a = prdp::diffusion(kappa, at::ones({}, options), {{Side::kRobin, Side::kRobin}}, {1.0},
                                 prdp::FaceMean::kHarmonic, {number, field});
  const auto u = prdp::linear_solve(a, at::ones({1, 1, 1}, options), {prdp::CG{.max_iter = 5}}).u;
  EXPECT_NEAR(u.item<double>(), 1.0 / 5.0, 1e-12);
  u.sum().backward();
  EXPECT_NEAR(number.grad().item<double>(), -0.25 / 25.0, 1e-12);
  EXPECT_NEAR(field.grad().item<double>(), -0.25 / 25.0, 1e-12);
  EXPECT_THROW(prdp::diffusion(kappa, number, {{Side::kRobin, Side::kZero}}), c10::ValueError);
}

TEST(LinearSolve, ACsrMatrixHasTheGradientOfItsValues) {
  const auto crow = at::tensor({0, 2, 4}, at::kLong), col = at::tensor({0, 1, 0, 1}, at::kLong);
  const auto values = at::tensor({3.0, 1.0, -1.0, 4.0}, at::kDouble).requires_grad_();
  const auto b = at::tensor({1.0, 2.0, 0.5, -1.0}, at::kDouble).view({2, 2});
  const prdp::SolveOptions options{prdp::Direct{}};
  const auto gradient = [&](const prdp::OperatorSpec& a) {
    const std::vector<at::Tensor> loss{prdp::linear_solve(a, b, options).u.square().sum()}, leaves{values};
    return torch::autograd::grad(loss, leaves)[0];
  };
  EXPECT_TRUE(at::allclose(gradient(prdp::csr_matrix(crow, col, values)), gradient(prdp::matrix(values.view({2, 2})))));
  EXPECT_THROW(prdp::csr_matrix(crow, col, values.narrow(0, 0, 3)), c10::ValueError);
  EXPECT_THROW(prdp::csr_matrix(crow.to(at::kDouble), col, values), c10::TypeError);
  EXPECT_THROW(prdp::linear_solve(prdp::csr_matrix(crow, col, values), at::Tensor(), options), c10::ValueError);
}

TEST(LinearSolve, ADiffusionTakesEverythingWithANumberAsShift) {
  const auto kappa = at::rand({1, 5}, at::kDouble) + 1.0, h = at::scalar_tensor(2.0, at::kDouble);
  const std::vector<prdp::Sides> sides{{prdp::Side::kRobin, prdp::Side::kZero}};
  const auto b = at::rand({1, 1, 5}, at::kDouble);
  const auto solve = [&](const auto& shift) {
    const auto a = prdp::diffusion(kappa, shift, sides, {1.0}, prdp::FaceMean::kArithmetic, {h});
    return prdp::linear_solve(a, b, {prdp::Direct{}}).u;
  };
  EXPECT_TRUE(at::equal(solve(10.0), solve(at::scalar_tensor(10.0, at::kDouble))));
}

TEST(Diffusion, OneSideAloneIsBothOfItsAxis) {
  using prdp::Side;
  const auto kappa = at::rand({1, 4, 5}, at::kDouble) + 1.0, u = at::rand({1, 1, 4, 5}, at::kDouble);
  const auto product = [&](const std::vector<prdp::Sides>& sides) {
    return prdp::make_operator(prdp::diffusion(kappa, 0.0, sides))->apply(u);
  };
  const auto of_flux = product({{Side::kFlux, Side::kFlux}, {Side::kFlux, Side::kFlux}});
  EXPECT_LT(of_flux.sum().abs().item<double>(), 1e-12);
  for (const auto& sides : std::vector<std::vector<prdp::Sides>>{
           {{Side::kFlux}}, {Side::kFlux}, {{Side::kFlux}, {Side::kFlux}}, {Side::kFlux, Side::kFlux}})
    EXPECT_TRUE(at::equal(product(sides), of_flux));
  EXPECT_FALSE(at::equal(product({{Side::kFlux, Side::kZero}}), of_flux));
}

TEST(Operators, WhatIsMissingIsNamed) {
  const at::Tensor none;
  const auto said = [](const auto& make) -> std::string {
    try {
      make();
    } catch (const c10::ValueError& error) {
      return error.what_without_backtrace();
    }
    return "nothing";
  };
  EXPECT_EQ(said([&] { prdp::diffusion(none, 0.0); }), "Diffusion: kappa is an undefined tensor");
  const auto closed = prdp::diffusion(at::ones({1, 4}), 0.0, {prdp::Side::kFlux});
  EXPECT_EQ(said([&] { prdp::with_null_space(closed); }), "with_null_space: the operator has a null space already");
  const prdp::OperatorSpec bare{"function", {}, {}, {}};
  EXPECT_EQ(said([&] { prdp::linear_solve(bare, at::ones({1, 4}), {prdp::CG{.max_iter = 1}}); }),
            "Function: its operator must come from spec() of RegisteredProducts");
}

}  // namespace
