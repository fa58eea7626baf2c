#pragma once
#include <optional>

#include "prdp/grid/grid.h"

namespace prdp {

/// ∂⟨λ, A u⟩ for the winds of Burgers or Navier-Stokes, like them, and for ν, a number: one launch each on a GPU;
/// nothing where there are no kernels.
struct UpwindGradients {
  at::Tensor winds, nu;
};
/// I + β (Γ - ν L) on every channel.
std::optional<UpwindGradients> burgers_rule_by_kernel(const Grid& grid, const at::Tensor& winds, double beta,
                                                      const at::Tensor& lambda, const at::Tensor& u);
/// I/dt + Γ - ν L on u₁ and u₂.
std::optional<UpwindGradients> navier_stokes_rule_by_kernel(const Grid& grid, const at::Tensor& winds,
                                                            const at::Tensor& lambda, const at::Tensor& u);

}  // namespace prdp
