#include "prdp/solvers/hierarchy_on_gpu.h"

#include <algorithm>
#include <limits>
#include <vector>

#include "prdp/gpu/kernel_text.h"
#include "prdp/gpu/team_memory.h"
#include "prdp/gpu/team_size.h"
#include "prdp/kernels/coarsening.h"

namespace prdp::gpu {

namespace {

/// Registers are short: each thread has many numbers of a stencil at hand.
constexpr int64_t kMostThreads = 512;

int64_t points_of(const at::Tensor& b) { return b.numel() / (b.size(0) * b.size(1)); }
int64_t offsets_of(const at::Tensor& b) {
  int64_t all = 1;
  for (int64_t d = 2; d < b.dim(); ++d) all *= 3;
  return all;
}

/// Points of all coarse grids together, those between two axes included, at most: which axes are coarsened, and in what
/// order, is known to the device alone. Each step makes one axis shorter, so it is the longest path over the sizes that
/// the three axes can have.
int64_t most_coarse_points(at::IntArrayRef shape) {
  std::vector<std::vector<int64_t>> sizes(3, {1});
  for (size_t d = 0; d < shape.size(); ++d) {
    sizes[d][0] = shape[d];
    while (sizes[d].back() > 1) sizes[d].push_back(kernels::coarse_points(sizes[d].back(), /*periodic=*/true));
  }
  const auto count = [&](size_t d) { return sizes[d].size(); };
  std::vector<int64_t> most_from(count(0) * count(1) * count(2), 0);  // each combination of sizes on
  const auto place = [&](size_t i, size_t j, size_t k) { return (i * count(1) + j) * count(2) + k; };
  for (size_t i = count(0); i-- > 0;)
    for (size_t j = count(1); j-- > 0;)
      for (size_t k = count(2); k-- > 0;) {
        const auto points_with = [&](size_t a, size_t b, size_t c) {
          if (a == count(0) || b == count(1) || c == count(2)) return int64_t{0};
          return sizes[0][a] * sizes[1][b] * sizes[2][c] + most_from[place(a, b, c)];
        };
        most_from[place(i, j, k)] =
            std::max({points_with(i + 1, j, k), points_with(i, j + 1, k), points_with(i, j, k + 1)});
      }
  return most_from[0];
}

template <class T>
void launch(const HierarchyKernel& kernel, const at::Tensor& hierarchy) {
  constexpr int64_t bytes_of_inverse = numbers_of_inverse(kMostOfCoarsest) * static_cast<int64_t>(sizeof(double));
  const int64_t teams = std::min(hierarchy.size(0), kernel.kernel->teams());
  const TeamMemory memory(kernel.blocks_of_team, teams, hierarchy.options(), teams * bytes_of_inverse);
  HierarchyArguments<T> arguments{};
  arguments.a = arguments_of(kernel.a);
  arguments.grids = grids_of(hierarchy);
  arguments.numbers = numbers_of<T>(hierarchy);
  arguments.numbers_of_sample = kernel.numbers_of_sample;
  arguments.work = memory.own<double>();
  arguments.samples = hierarchy.size(0);
  arguments.nullity = kernel.nullity;
  arguments.nullities = kernel.nullities.defined() ? kernel.nullities.const_data_ptr<int64_t>() : nullptr;
  memory.put_into(arguments);
  kernel.kernel->launch(teams, &arguments);
}

}  // namespace

HierarchyKernel hierarchy_kernel(Runtime& runtime, OperatorView a, const at::Tensor& b) {
  const int64_t points = points_of(b), offsets = offsets_of(b);
  if (offsets * points > std::numeric_limits<int32_t>::max())
    throw Unavailable("a grid of " + std::to_string(points) + " points is too large for a kernel of multigrid");
  auto limits = runtime.limits(b.device());
  limits.threads = std::min(limits.threads, kMostThreads);
  const auto [blocks, threads] = team_size(points, limits);
  KernelText text;
  text << "#include \"prdp/gpu/device/hierarchy.h\"\nusing namespace prdp::gpu;\n"
       << "using S = HierarchySetting<" << type_of(b.scalar_type()) << ", " << a.type << ", " << b.dim() - 2 << ", "
       << blocks << ", " << threads << ">;\n"
       << "using Arguments = HierarchyArguments<S::T>;\n"
       << "extern \"C\" __global__ void __launch_bounds__(S::kThreads) prdp_kernel(const __grid_constant__ Arguments "
          "arguments) {\n"
          "  make_hierarchies<S>(arguments);\n}\n";
  const int64_t weights = 4 * points, inverse = kMostOfCoarsest * kMostOfCoarsest;
  const int64_t numbers = offsets * (points + most_coarse_points(b.sizes().slice(2))) + weights + inverse;
  const auto& basis = a.null_space;
  const int64_t nullity = !a.needs_projection || !basis.defined() ? 0 : basis.numel() == 0 ? 1 : basis.size(-2);
  const bool of_samples = nullity > 0 && basis.dim() == 3 && basis.size(0) > 1;
  const auto nullities = of_samples ? basis.ne(0).any(-1).sum(-1) : at::Tensor();
  auto kernel = runtime.kernel(b.device(), {text.str(), threads, 0, blocks});
  return {std::move(kernel), std::move(a), blocks, numbers, nullity, nullities};
}

at::Tensor make_hierarchy(const HierarchyKernel& kernel, const at::Tensor& b) {
  const auto numbers_of_grids = static_cast<int64_t>(sizeof(Grids) / b.element_size());
  const auto hierarchy =
      at::empty({is_shared(kernel.a) ? 1 : b.size(0), numbers_of_grids + kernel.numbers_of_sample}, b.options());
  (b.scalar_type() == at::kFloat ? launch<float> : launch<double>)(kernel, hierarchy);
  return hierarchy;
}

CycleMemory memory_of_cycle(const at::Tensor& b) {
  constexpr int64_t vectors = 3;  // b, x and y of a coarse grid; kVectorsOfCycle are x, y and spare of the finest
  auto shape = b.sizes().slice(2).vec();
  int64_t usual = 0;
  const auto is_long = [](int64_t n) { return n > kernels::kCoarsest; };
  while (std::any_of(shape.begin(), shape.end(), is_long)) {
    int64_t points = 1;
    for (auto& n : shape) points *= n = is_long(n) ? kernels::coarse_points(n, /*periodic=*/true) : n;
    usual += points;
  }
  const int64_t of_points = vectors * b.size(1);
  return {of_points * most_coarse_points(b.sizes().slice(2)), of_points * usual};
}

}  // namespace prdp::gpu
