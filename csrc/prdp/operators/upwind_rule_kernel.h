#pragma once
#include <optional>
#include <vector>

#include "prdp/grid/grid.h"

namespace prdp {

/// ∂⟨λ, A u⟩ for the winds of Burgers or Navier-Stokes, like them, and for ν.
struct UpwindGradients {
  at::Tensor winds;
  std::vector<at::Tensor> nu_terms;  // each (batch, …), whose sums are the derivative
};
/// One launch each on a GPU; nothing where there are no kernels.
/// I + β (Γ - ν L) on every channel.
std::optional<UpwindGradients> burgers_rule_by_kernel(const Grid& grid, const at::Tensor& winds, double beta,
                                                      const at::Tensor& lambda, const at::Tensor& u);
/// I/dt + Γ - ν L on u₁ and u₂.
std::optional<UpwindGradients> navier_stokes_rule_by_kernel(const Grid& grid, const at::Tensor& winds,
                                                            const at::Tensor& lambda, const at::Tensor& u);

}  // namespace prdp
