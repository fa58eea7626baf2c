#include "prdp/autograd/detach_failed.h"

#include <ATen/TensorSubclassLikeUtils.h>
#include <torch/library.h>

#include "prdp/autograd/solve_vjp.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/status.h"

namespace prdp {

at::Tensor detach_failed(const at::Tensor& u, const at::Tensor& status) {
  const bool rollout = status.dim() == 2;
  TORCH_CHECK_VALUE(status.dim() == 1 || rollout,
                    "detach_failed: status must have shape (batch,) or (batch, steps), got ", status.sym_sizes());
  TORCH_CHECK_VALUE(u.dim() > status.dim() && u.sym_size(0) == status.sym_size(0) &&
                        (!rollout || u.sym_size(1) == status.sym_size(1) + 1),
                    "detach_failed: u of shape ", u.sym_sizes(), " does not fit a status of shape ",
                    status.sym_sizes());
  auto failed = is_failure(status);
  if (!at::isTensorSubclassLike(failed) && !failed.any().item<bool>()) return u;
  if (rollout) failed = at::constant_pad_nd(failed.cumsum(1), {1, 0}).gt(0);
  return at::where(per_sample(failed, u), u.detach(), u);
}

bool any_nonfinite(const at::Tensor& status) {
  if (!status.is_cpu() || at::isTensorSubclassLike(status)) return false;
  return status.le(static_cast<int64_t>(SolveStatus::kNonfiniteInput)).any().item<bool>();
}

void block_gradients_of_failed(const at::Tensor& u, const at::Tensor& status, OnFailure on_failure) {
  if (on_failure == OnFailure::kRaise || !u.requires_grad() || in_torch_func()) return;
  u.register_hook([status, on_failure](const at::Tensor& u_bar) { return without_failed(u_bar, status, on_failure); });
}

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def("detach_failed(Tensor u, Tensor status) -> Tensor", detach_failed); }
// torch.func.vmap goes through what it is made of.
TORCH_LIBRARY_IMPL(prdp, FuncTorchBatchedDecomposition, m) { m.impl("detach_failed", detach_failed); }

}  // namespace prdp
