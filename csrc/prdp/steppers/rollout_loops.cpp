#include "prdp/steppers/rollout_loops.h"

#include <ATen/core/grad_mode.h>

#include "prdp/autograd/op_results.h"

namespace prdp {

SolveInfo side_by_side(std::vector<SolveInfo> infos, const at::Tensor& u) {
  if (infos.empty()) return empty_info(u, {u.sym_size(0), 0});
  SolveInfo all;
  const auto solves = static_cast<int64_t>(infos.size());
  const auto joined = all.parts();
  for (size_t part = 0; part < joined.size(); ++part) {
    std::vector<at::Tensor> of_solves;
    for (auto& info : infos) of_solves.push_back(*info.parts()[part]);
    const auto batch = of_solves[0].sym_size(0);
    *joined[part] = at::cat(of_solves).view_symint({solves, batch}).t().contiguous();  // stack() takes longer
  }
  return all;
}

at::Tensor from_state(const at::Tensor& u, const at::Tensor& solutions) {
  if (!at::GradMode::is_enabled() || !u.requires_grad()) return solutions;
  return at::cat({u.unsqueeze(1), solutions.slice(1, 1)}, 1);
}

}  // namespace prdp
