#include "prdp/solvers/solve_kernel_text.h"

#include <algorithm>
#include <limits>

#include "prdp/gpu/kernel_text.h"
#include "prdp/gpu/team_size.h"
#include "prdp/solvers/hierarchy_on_gpu.h"
#include "prdp/solvers/methods.h"

namespace prdp::gpu {

namespace {

/// Of GMRES: a thread keeps its triangle, so longer bases would fill the device with copies of it.
constexpr int64_t kLongestBasis = 50;

/// Bytes of the arrays that a method's members take by array<X>(), each of whole eight bytes.
int64_t bytes_of(const ArraySizes& sizes, int64_t number) {
  constexpr int64_t pointer = 8, padding = 8;
  return sizes.vectors * pointer + sizes.numbers * number + sizes.arrays * padding;
}

/// What the text of a kernel is made of, as setting.h names it.
struct Sizes {
  int64_t blocks, threads, vectors, vectors_in_block, bytes_of_arrays, restart;
  int64_t cycle_vectors, cycle_in_block, cycle_at_most;
};

std::string text_of(const Sizes& sizes, const OperatorView& a, const Solver& solver, const at::Tensor& b) {
  const auto& row = traits(solver.method);
  KernelText text;
  text << "#include \"prdp/gpu/device/solve.h\"\n#include \"prdp/solvers/" << row.kernel_header << "\"\n"
       << "using namespace prdp::gpu;\n"
       << "using S = Setting<" << type_of(b.scalar_type()) << ", " << a.type << ", ";
  for (const int64_t n : {sizes.blocks, sizes.threads, sizes.vectors, sizes.vectors_in_block,
                          int64_t{solver.preconditioner.is_diagonal()}, int64_t{divides_by_diagonal(solver)},
                          sizes.bytes_of_arrays, sizes.restart})
    text << n << ", ";
  if (solver.preconditioner.is_multigrid())
    text << "CycleSetting<" << b.dim() - 2 << ", " << sizes.cycle_vectors << ", " << sizes.cycle_in_block << ", "
         << sizes.cycle_at_most << ">";
  else text << "NoCycleSetting";
  text << ">;\nusing Method = prdp::" << row.kernel << "<BlockSpace<S>>;\n"
       << "using Arguments = SolveArguments<S::T>;\n"
       << "extern \"C\" __global__ void __launch_bounds__(S::kThreads) prdp_kernel(const __grid_constant__ Arguments "
          "arguments) {\n"
          "  PRDP_BLOCK_MEMORY(memory);\n"
          "  solve_batch<Method, S>(arguments, reinterpret_cast<S::T*>(memory));\n}\n";
  return text.str();
}

}  // namespace

bool has_kernel(const Solver& solver) {
  const auto& row = traits(solver.method);
  return !row.kernel.empty() && !solver.preconditioner.is_operator() &&
         (row.counts != Counts::kCycles || solver.restart <= kLongestBasis);
}

SolveKernel solve_kernel(const OperatorView& a, bool is_saddle_point, const Solver& solver, const at::Tensor& b,
                         const Limits& limits) {
  const int64_t unknowns = b.numel() / b.size(0);
  if (unknowns > std::numeric_limits<int32_t>::max() / 2)
    throw Unavailable("a sample of " + std::to_string(unknowns) + " unknowns is too large for a kernel");
  const auto& row = traits(solver.method);
  const bool is_restarted = row.counts == Counts::kCycles, by_multigrid = solver.preconditioner.is_multigrid();
  const int64_t number = b.element_size(), restart = is_restarted ? std::min(solver.restart, unknowns) : 0;
  const int64_t cycle_vectors = !by_multigrid ? 0 : is_saddle_point ? 2 * kVectorsOfCycle : kVectorsOfCycle;
  const int64_t vectors = kOwnVectors + vectors_of(solver.method, restart) + cycle_vectors;
  const auto [blocks, threads] = team_size(unknowns, limits);
  // Coarse grids come first into the memory of the block, then the vectors of the finest one.
  const CycleMemory cycle = by_multigrid ? memory_of_cycle(b) : CycleMemory{};
  const int64_t of_block = blocks > 1 ? 0 : limits.block_memory / number;
  const int64_t cycle_in_block = cycle.if_all_axes <= of_block ? cycle.if_all_axes : 0;
  const int64_t in_block = std::min(vectors, (of_block - cycle_in_block) / unknowns);
  const Sizes sizes{.blocks = blocks,
                    .threads = threads,
                    .vectors = vectors,
                    .vectors_in_block = in_block,
                    .bytes_of_arrays = bytes_of(row.arrays(restart), number),
                    .restart = restart,
                    .cycle_vectors = cycle_vectors,
                    .cycle_in_block = cycle_in_block,
                    .cycle_at_most = cycle.at_most};
  return {{text_of(sizes, a, solver, b), threads, (in_block * unknowns + cycle_in_block) * number, blocks},
          (vectors - in_block) * unknowns + numbers_beyond(restart) + cycle.at_most};
}

}  // namespace prdp::gpu
