#include "prdp/solvers/solve.h"

#include <ATen/EmptyTensor.h>

#include <optional>

#include "prdp/kernels/factor_cache.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/solve_direct.h"
#include "prdp/solvers/solve_on_gpu.h"
#include "prdp/solvers/solve_samples.h"
#include "prdp/solvers/tensor_start.h"
#include "prdp/solvers/unnamed_null_space.h"
#include "prdp/threads/share_samples.h"

namespace prdp {

namespace {

/// How a solve is computed: in one launch on a GPU, by the loops of the CPU, or by tensor operations.
enum class Way { kKernel, kLoops, kTensors };
thread_local std::optional<Way> last_way;

/// Past the dispatcher: small solves take no longer than a few of its calls.
at::Tensor empty(at::IntArrayRef sizes, at::ScalarType dtype) { return at::detail::empty_cpu(sizes, dtype); }

SolveInfo empty_info(int64_t batch, at::ScalarType real) {
  return {empty(batch, at::kLong), empty(batch, real), empty(batch, at::kLong), empty(batch, at::kLong),
          empty(batch, real)};
}

/// Whether this solver runs in the CPU loops, if the operator has any.
bool runs_on_loops(const Solver& solver) { return !solver.preconditioner.is_operator(); }

/// `shared`: null if the samples have an operator each, of `kernels`.
template <class T>
SolveResult solve_samples_of(const kernels::KernelBatch<T>& kernels, const SharedSystem<T>* shared, const at::Tensor& b,
                             const SolveRequest& request) {
  const auto rhs = b.contiguous();
  SolveResult result{empty(rhs.sizes(), rhs.scalar_type()), empty_info(rhs.size(0), rhs.scalar_type())};
  const auto& solver = request.solver;
  const int64_t size = rhs.size(0), unknowns = rhs.numel() / std::max<int64_t>(size, 1);
  const auto caps = request.caps ? request.caps->contiguous() : at::Tensor();
  const auto x0 = takes_start(solver.method, request.x0) ? request.x0.contiguous() : at::Tensor();
  const SampleBatch<T> batch{solver, unknowns, arrays_of<T>(request, rhs, x0, caps, result)};
  const auto solve_range = [&](int64_t begin, int64_t end) { solve_samples(kernels, shared, batch, begin, end); };
  share_samples(size, unknowns, grain_size(solver.method, size, unknowns, batch.arrays.max_iter, solver.restart),
                solve_range);
  return result;
}

/// What the kernel of a direct solve is kept by: it takes longer to make than to find by its numbers.
std::optional<kernels::FactorKey> key_of_kernel(const Operator& a, const at::Tensor& b, const Solver& solver) {
  const auto of_a = traits(solver.method).is_direct ? a.key(/*transposed=*/false) : std::nullopt;
  return of_a ? std::optional(kernels::FactorKeyMaker().add(*of_a).add(b.size(1)).key()) : std::nullopt;
}

/// Nothing if A has no loops.
template <class T>
std::optional<SolveResult> solve_on_loops(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  using Kernel = kernels::Kernel<T>;
  const auto& solver = request.solver;
  const auto key = key_of_kernel(a, b, solver);
  if (const auto kept = key ? factor_cache::find(*key, typeid(Kernel)) : nullptr) {
    const auto system = system_of<T>(std::static_pointer_cast<const Kernel>(kept), solver);
    return solve_samples_of<T>({/*is_shared=*/true, {}}, system.get(), b, request);
  }
  const auto kernels = a.kernels(b, false);
  if (!kernels) return std::nullopt;
  const auto& batch = std::get<kernels::KernelBatch<T>>(kernels->of_dtype);
  const auto shared = b.size(0) > 0 ? shared_system(batch, solver) : nullptr;
  if (key && shared && shared->a) factor_cache::keep(*key, typeid(Kernel), shared->a, shared->a->bytes());
  return solve_samples_of(batch, shared.get(), b, request);
}

}  // namespace

const char* way_of_last_solve() {
  if (!last_way) return "";
  switch (*last_way) {
    case Way::kKernel: return "kernel";
    case Way::kLoops: return "loops";
    default: return "tensors";
  }
}

SolveInfo info_of(const std::vector<SampleOutcome>& outcomes, at::ScalarType real) {
  const auto batch = static_cast<int64_t>(outcomes.size());
  auto info = empty_info(batch, at::kDouble);
  for (int64_t i = 0; i < batch; ++i) {
    const auto& o = outcomes[i];
    info.iterations.mutable_data_ptr<int64_t>()[i] = o.iterations;
    info.residual.mutable_data_ptr<double>()[i] = o.residual;
    info.status.mutable_data_ptr<int64_t>()[i] = static_cast<int64_t>(o.status);
    info.operator_applications.mutable_data_ptr<int64_t>()[i] = o.applications;
    info.floor.mutable_data_ptr<double>()[i] = o.floor;
  }
  for (auto* part : {&info.residual, &info.floor}) *part = part->to(real);
  return info;
}

int64_t grain_size(Method method, int64_t samples, int64_t unknowns, int64_t iterations, int64_t restart) {
  constexpr double worthwhile = 1e5;
  const double steps = steps_of(method, iterations, std::min(restart, unknowns));
  const double work =
      traits(method).nanoseconds * static_cast<double>(samples * unknowns) * (std::min(steps, 1000.0) + 4.0);
  const int64_t threads = std::max<int64_t>(1, static_cast<int64_t>(work / worthwhile));
  return at::divup(samples, threads);
}

SolveResult solve(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  if (traits(request.solver.method).made_for == MadeFor::kKnownSpectrum && !a.knows_jacobi_radius())
    a.jacobi_radius();  // raises
  auto found = gpu::solve(a, b, request);
  // A kernel looks at them on the device. None ran: the host does.
  if (!found && gpu::may_run_kernel(b, request.solver)) a.check_parameters(request.checks);
  auto way = Way::kKernel;
  if (!found && b.is_cpu() && runs_on_loops(request.solver)) {
    way = Way::kLoops;
    found =
        b.scalar_type() == at::kFloat ? solve_on_loops<float>(a, b, request) : solve_on_loops<double>(a, b, request);
  }
  if (!found) {
    way = Way::kTensors;
    found = solve_direct_at_once(a, b, request);
    if (!found) found = solve_with_tensors(a, b, request);
  }
  last_way = way;
  // Left out after a kernel that nobody waits for: on a GPU it takes some sixty operations of torch.
  const bool is_awaited = request.may_wait || found->info.status.is_cpu() || way != Way::kKernel;
  if (is_awaited) mark_inconsistent_constants(a, b, request, *found);
  return *std::move(found);
}

}  // namespace prdp
