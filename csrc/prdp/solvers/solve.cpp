#include "prdp/solvers/solve.h"

#include <ATen/EmptyTensor.h>

#include "prdp/solvers/methods.h"
#include "prdp/solvers/solve_cpu.h"
#include "prdp/threads/interruption.h"

namespace prdp {

namespace {

/// Past the dispatcher: small solves take no longer than a few of its calls.
at::Tensor empty(at::IntArrayRef sizes, at::ScalarType dtype) { return at::detail::empty_cpu(sizes, dtype); }

SolveInfo empty_info(const at::Tensor& b) {
  const int64_t batch = b.size(0);
  return {empty(batch, at::kLong), empty(batch, b.scalar_type()), empty(batch, at::kLong), empty(batch, at::kLong)};
}

/// Whether the CPU loops run this method for the operator with these parameters.
bool has_loops(Method method, const KernelParameters& parameters) {
  switch (traits(method).runs_on) {
    case RunsOn::kAllLoops: return !std::holds_alternative<std::monostate>(parameters);
    case RunsOn::kLaplacianLoops: return std::holds_alternative<kernels::LaplacianParameters>(parameters);
    case RunsOn::kTensors: break;
  }
  return false;
}

template <class T, class Parameters>
SolveResult solve_on_cpu(const Parameters& a, const at::Tensor& b, const SolveRequest& request) {
  const auto rhs = b.contiguous();
  SolveResult result{empty(rhs.sizes(), rhs.scalar_type()), empty_info(rhs)};
  const int64_t size = rhs.size(0);
  const auto caps = request.caps ? request.caps->contiguous() : at::Tensor();
  const auto x0 = request.x0.defined() ? request.x0.contiguous() : at::Tensor();
  const SampleBatch<T> batch{request.method,
                             request.max_iter,
                             request.rtol,
                             request.restart,
                             caps.defined() ? caps.const_data_ptr<int64_t>() : nullptr,
                             request.guarded,
                             rhs.const_data_ptr<T>(),
                             x0.defined() ? x0.const_data_ptr<T>() : nullptr,
                             result.u.mutable_data_ptr<T>(),
                             result.info.iterations.mutable_data_ptr<int64_t>(),
                             result.info.residual.mutable_data_ptr<T>(),
                             result.info.status.mutable_data_ptr<int64_t>(),
                             result.info.operator_applications.mutable_data_ptr<int64_t>()};
  const int64_t unknowns = rhs.numel() / std::max<int64_t>(size, 1);
  interruption::parallel_for(0, size, grain_size(request.method, size, unknowns, request.max_iter, request.restart),
                             [&](int64_t begin, int64_t end) { solve_range(a, batch, begin, end); });
  return result;
}

}  // namespace

int64_t grain_size(Method method, int64_t samples, int64_t unknowns, int64_t iterations, int64_t restart) {
  constexpr double worthwhile = 1e5;
  const double steps = steps_of(method, iterations, std::min(restart, unknowns));
  const double work =
      traits(method).nanoseconds * static_cast<double>(samples * unknowns) * (std::min(steps, 1000.0) + 4.0);
  const int64_t threads = std::max<int64_t>(1, static_cast<int64_t>(work / worthwhile));
  return at::divup(samples, threads);
}

SolveResult solve(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  const auto parameters = a.kernel(b);
  if (!b.is_cpu() || !has_loops(request.method, parameters)) return solve_with_tensors(a, b, request);
  return std::visit(
      [&](const auto& p) -> SolveResult {
        if constexpr (std::is_same_v<std::decay_t<decltype(p)>, std::monostate>) {
          TORCH_INTERNAL_ASSERT(false);
        } else if (b.scalar_type() == at::kFloat) {
          return solve_on_cpu<float>(p, b, request);
        } else {
          return solve_on_cpu<double>(p, b, request);
        }
      },
      parameters);
}

}  // namespace prdp
