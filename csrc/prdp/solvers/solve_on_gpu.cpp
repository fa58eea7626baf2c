#include "prdp/solvers/solve_on_gpu.h"

#include <ATen/core/grad_mode.h>

#include "prdp/gpu/fall_back.h"
#include "prdp/gpu/part_of.h"
#include "prdp/gpu/team_memory.h"
#include "prdp/solvers/first_result.h"
#include "prdp/solvers/hierarchy_on_gpu.h"
#include "prdp/solvers/kept_hierarchy.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/solve_kernel_text.h"

namespace prdp::gpu {

namespace {

constexpr const char* kDisagrees =
    "the first result of a kernel is not that of tensor operations; please report this, with your device";

/// Why a solve has no kernel, which is no fault.
std::string not_made(const Solver& solver) {
  return std::string(traits(solver.method).label) + (solver.preconditioner ? " with this preconditioner" : "") +
         " has no kernel";
}

/// Entries of a vector that a null space belongs to: those of a channel, or of all that it spans.
int64_t length_of(const at::Tensor& basis, const at::Tensor& b) {
  if (basis.defined() && basis.numel() > 0) return basis.size(-1);
  return b.numel() / (b.size(0) * (b.dim() < 3 ? 1 : b.size(1)));
}

template <class T>
NullSpaceArguments<T> arguments_of(const at::Tensor& basis, const at::Tensor& b, int64_t field) {
  if (!basis.defined()) return {};
  const bool constant = basis.numel() == 0, one = field >= 0;
  const int64_t length = length_of(basis, b), unknowns = b.numel() / b.size(0);
  return {.basis = constant ? nullptr : basis.const_data_ptr<T>(),
          .sample = basis.dim() == 3 && basis.size(0) > 1 ? basis.stride(0) : 0,
          .count = constant ? 1 : basis.size(-2),
          .first = one ? field : 0,
          .fields = one ? 1 : unknowns / length,
          .length = length};
}

/// A kernel, with all that its launch needs.
struct ReadyKernel {
  std::shared_ptr<const Kernel> kernel;
  SolveKernel spec;
  OperatorView a;
  at::Tensor hierarchy;  // undefined without cycles
};

/// Memory for a report, in one piece: each operation of torch takes its time. Or `apart`, as a compiled graph wants it.
SolveInfo new_report(const at::Tensor& b, bool apart) {
  const int64_t batch = b.size(0);
  const auto whole = apart ? at::Tensor() : at::empty({5 * batch}, b.options().dtype(at::kLong));
  const auto part = [&](int64_t k, at::ScalarType dtype) {
    return apart ? at::empty({batch}, b.options().dtype(dtype))
                 : part_of(whole, k * batch * static_cast<int64_t>(sizeof(int64_t)), batch, dtype);
  };
  const auto real = b.scalar_type();
  return {part(0, at::kLong), part(1, real), part(2, at::kLong), part(3, at::kLong), part(4, real)};
}

template <class T>
SolveResult launch(const ReadyKernel& ready, const at::Tensor& b, const SolveRequest& request) {
  const auto& [kernel, spec, a, hierarchy] = ready;
  const int64_t batch = b.size(0);
  SolveResult result{at::empty(b.sizes(), b.options()), new_report(b, request.report_apart)};
  const int64_t blocks = spec.source.blocks_of_team;
  const int64_t teams = kernel->teams_for(batch, blocks, /*have_memory=*/spec.memory_of_team > 0);
  const TeamMemory memory(blocks, teams, b.options(), teams * spec.memory_of_team * b.element_size());
  const auto caps = request.caps ? request.caps->to(b.device(), at::kLong).contiguous() : at::Tensor();
  const auto x0 = request.x0.defined() ? request.x0.contiguous() : at::Tensor();

  SolveArguments<T> arguments{};
  arguments.a = arguments_of(a);
  arguments.null_space = arguments_of<T>(a.null_space, b, a.null_field);
  arguments.left_null_space = arguments_of<T>(a.left_null_space, b, a.null_field);
  arguments.arrays = arrays_of<T>(request, b, x0, caps, result);
  arguments.memory = memory.own<T>();
  memory.put_into(arguments);
  arguments.batch = batch;
  arguments.needs_projection = a.needs_projection;
  if (hierarchy.defined()) {
    const auto& preconditioner = request.solver.preconditioner;
    arguments.hierarchy = {.grids = grids_of(hierarchy),
                           .numbers = numbers_of<T>(hierarchy),
                           .numbers_of_sample = hierarchy.size(0) == 1 ? 0 : numbers_of_sample(hierarchy),
                           .smoothing = preconditioner.smoothing(),
                           .transposed = preconditioner.spec().transposed};
  }
  kernel->launch(teams, &arguments);
  return result;
}

/// For A, or Aᵀ; `kept` may have its coarse grids, or keeps them. Nothing where there is no kernel.
std::optional<ReadyKernel> prepare(const Operator& a, bool transposed, const at::Tensor& b, const Solver& solver,
                                   KeptHierarchy* kept) {
  auto* const runtime = runtime_of(b.device());
  if (!runtime || b.numel() == 0) return std::nullopt;
  const auto by_design = [](const std::string& reason) {
    TORCH_CHECK(use() != Use::kRequired, "PRDP_GPU=required: ", reason);
    return std::nullopt;
  };
  if (!has_kernel(solver)) return by_design(not_made(solver));
  auto view = a.gpu_view(b, transposed);
  if (!view) return by_design("this operator has no kernel");
  return or_fall_back([&]() -> std::optional<ReadyKernel> {
    const auto& m = solver.preconditioner;
    auto hierarchy = m.is_multigrid() && kept ? kept->get() : at::Tensor();
    std::optional<HierarchyKernel> maker;
    // The grids are those of the forward A, also where this is its transpose.
    if (m.is_multigrid() && !hierarchy.defined())
      maker = hierarchy_kernel(*runtime, *a.gpu_view(b, transposed != m.spec().transposed), b);
    const auto spec =
        solve_kernel(*view, /*is_saddle_point=*/!a.has_coarse_grids(), solver, b, runtime->limits(b.device()));
    auto kernel = runtime->kernel(b.device(), spec.source);
    note_made(std::string(traits(solver.method).label) + " of " + view->type);
    if (maker) hierarchy = make_hierarchy(*maker, b);
    if (maker && kept) kept->keep(hierarchy);
    return ReadyKernel{std::move(kernel), spec, *std::move(view), std::move(hierarchy)};
  });
}

}  // namespace

std::optional<SolveResult> solve(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  auto* const runtime = runtime_of(b.device());
  if (!runtime) return std::nullopt;
  const at::NoGradGuard no_grad;
  const auto rhs = b.contiguous();
  const auto ready = prepare(a, /*transposed=*/false, rhs, request.solver, request.hierarchy);
  if (!ready) return std::nullopt;
  const auto launch_as = rhs.scalar_type() == at::kFloat ? launch<float> : launch<double>;
  auto& trust = ready->kernel->trust;
  return or_fall_back([&]() -> std::optional<SolveResult> {
    if (trust == Trust::kNone) throw Unavailable(kDisagrees);
    auto found = launch_as(*ready, rhs, request);
    constexpr int few = 3;  // a check waits for the device, and there may be nothing to judge, as where b is 0
    const bool is_due = trust == Trust::kUnknown && request.guarded && ready->kernel->checks < few;
    if (is_due && !runtime->is_capturing(b.device())) {
      ++ready->kernel->checks;
      trust = verify_first_result(a, rhs, request, found);
      if (trust == Trust::kNone) throw Unavailable(kDisagrees);
    }
    return found;
  });
}

Product make_cycle(const Operator& a, bool transposed, const Preconditioner& m, const at::Tensor& like) {
  if (!a.has_coarse_grids()) return {};  // the blocks of NavierStokes for Aᵀ are not the transpose of those for A
  const Solver solver{Method::kMultigrid, 1, 0.0, kDefaultRestart, transposed ? m.transposed() : m};
  auto made = prepare(a, transposed, like, solver, /*kept=*/nullptr);
  if (!made || made->kernel->trust == Trust::kNone) return {};
  return [ready = *std::move(made), solver](const at::Tensor& v) {
    const auto launch_as = v.scalar_type() == at::kFloat ? launch<float> : launch<double>;
    return launch_as(ready, v.contiguous(), {.solver = solver, .guarded = false}).u;
  };
}

bool may_run_kernel(const at::Tensor& b, const Solver& solver) { return runtime_of(b.device()) && has_kernel(solver); }

void share_hierarchy(SolveOptions& options, const at::Tensor& b, int64_t solves) {
  if (options.hierarchy || !options.solver.preconditioner.is_multigrid() || !runtime_of(b.device())) return;
  options.hierarchy = std::make_shared<KeptHierarchy>(4 * solves * static_cast<int64_t>(b.nbytes()));
}

void share_hierarchy(SolveOptions& options, const at::Tensor& b, std::shared_ptr<KeptHierarchy> of_all) {
  auto* const runtime = runtime_of(b.device());
  if (!runtime || !options.solver.preconditioner.is_multigrid()) return;
  or_fall_back([&] {  // to ask whether a graph is captured may raise Unavailable
    if (!runtime->is_capturing(b.device())) options.hierarchy = std::move(of_all);
    return true;
  });
}

}  // namespace prdp::gpu
