#include "prdp/solvers/memory_check.h"

#include <ATen/Parallel.h>
#include <unistd.h>

#include <algorithm>

#include "prdp/error_text.h"
#include "prdp/solvers/methods.h"

namespace prdp {

namespace {

std::string gigabytes(double bytes) { return three_digits(bytes / 1e9) + " GB"; }

}  // namespace

double physical_memory() {
  return static_cast<double>(sysconf(_SC_PHYS_PAGES)) * static_cast<double>(sysconf(_SC_PAGE_SIZE));
}

void check_memory(const SolveOptions& options, const at::Tensor& b, bool all_samples_at_once) {
  const auto& solver = options.solver;
  constexpr int64_t kAlwaysFits = 1000;
  if (solver.restart <= kAlwaysFits || traits(solver.method).counts != Counts::kCycles) return;
  if (!b.is_cpu() || b.dim() == 0 || b.numel() == 0) return;
  const int64_t batch = b.size(0), unknowns = b.numel() / batch;
  // The basis, and the products of its vectors with each other.
  const auto m = static_cast<double>(std::min(solver.restart, unknowns));
  const auto n = static_cast<double>(unknowns), number = static_cast<double>(b.element_size());
  const auto at_once = static_cast<double>(std::min<int64_t>(batch, at::get_num_threads()));
  // Where tensor operations take all samples at once, the products are numbers of float64.
  const double bytes = all_samples_at_once ? static_cast<double>(batch) * m * (n * number + m / 2 * sizeof(double))
                                           : at_once * m * (n + m) * number;
  TORCH_CHECK_VALUE(bytes <= physical_memory(), "GMRES: restart = ", solver.restart, " on ", unknowns,
                    " unknowns would take ", gigabytes(bytes), ", and this machine has ", gigabytes(physical_memory()),
                    "; lower restart");
}

}  // namespace prdp
