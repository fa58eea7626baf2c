#include "prdp/solvers/solve_kernel.h"

#include <algorithm>
#include <limits>
#include <sstream>

#include "prdp/gpu/launch.h"
#include "prdp/solvers/methods.h"

namespace prdp::gpu {

namespace {

/// Of GMRES: a thread keeps its triangle, so longer bases would fill the device with copies of it.
constexpr int64_t kLongestBasis = 50;

/// Bytes of the small arrays of a method, each of whole eight bytes.
int64_t bytes_of_arrays(Method method, int64_t restart, int64_t number) {
  constexpr int64_t pointer = 8, weights_at_once = 64, numbers_of_column = 6, arrays = 8;
  if (method == Method::kChebyshev) return weights_at_once * number;
  if (method == Method::kMinres) return 3 * pointer + 3 * 8;
  if (traits(method).counts != Counts::kCycles) return 0;
  const int64_t columns = restart + 1;
  const int64_t numbers = restart * columns + numbers_of_column * columns + 2 * columns + 2 * restart;
  return columns * pointer + numbers * number + arrays * 8;
}

}  // namespace

bool has_kernel(const Solver& solver) {
  const auto& row = traits(solver.method);
  const bool preconditioned = solver.preconditioner && !solver.preconditioner.is_diagonal();
  return !row.kernel.empty() && !preconditioned && (row.counts != Counts::kCycles || solver.restart <= kLongestBasis);
}

SolveKernel solve_kernel(const OperatorView& a, const Solver& solver, at::ScalarType dtype, int64_t unknowns,
                         const Limits& limits) {
  if (unknowns > std::numeric_limits<int32_t>::max() / 2)
    throw Unavailable("a sample of " + std::to_string(unknowns) + " unknowns is too large for a kernel");
  const auto& row = traits(solver.method);
  const int64_t number = dtype == at::kFloat ? 4 : 8;
  const bool has_cycles = row.counts == Counts::kCycles;
  const int64_t restart = has_cycles ? std::min(solver.restart, unknowns) : 0;
  const int64_t vectors = kOwnVectors + vectors_of(solver.method, restart);
  const auto [blocks, threads] = team_size(unknowns, limits);
  const int64_t in_block = blocks > 1 ? 0 : std::min(vectors, limits.block_memory / (unknowns * number));
  const bool by_diagonal = solver.preconditioner.is_diagonal();

  std::ostringstream text;
  text << "#include \"prdp/gpu/device/solve.h\"\n#include \"prdp/solvers/" << row.kernel_header << "\"\n"
       << "using namespace prdp::gpu;\n"
       << "using S = Setting<" << type_of(dtype) << ", " << a.type << ", " << blocks << ", " << threads << ", "
       << vectors << ", " << in_block << ", " << by_diagonal << ", " << divides_by_diagonal(solver) << ", "
       << bytes_of_arrays(solver.method, restart, number) << ", " << restart << ">;\n"
       << "using Arguments = SolveArguments<S::T>;\n"
       << "using Method = prdp::" << row.kernel << "<BlockSpace<S>>;\n"
       << "extern \"C\" __global__ void __launch_bounds__(S::kThreads) prdp_kernel(const Arguments arguments) "
          "{\n  PRDP_BLOCK_MEMORY(memory);\n"
          "  solve_batch<Method, S>(arguments, reinterpret_cast<S::T*>(memory));\n}\n";
  return {{text.str(), threads, in_block * unknowns * number, blocks},
          (vectors - in_block) * unknowns + numbers_beyond(restart)};
}

}  // namespace prdp::gpu
