#pragma once
#include "prdp/steppers/equation.h"

namespace prdp {

/// `steps` >= 0 steps in a row as one node of autograd: the states from u on, u included,
/// (batch, steps + 1, channel, *shape), and a SolveInfo of tensors (batch, steps). Values and gradients
/// are those of as many calls of step(), to the last bit, whose backward passes run one after the other
/// in a single one; its adjoint log holds tensors (batch, steps) too. Kept for it are the states, where A
/// depends on them or on a tensor that wants a gradient, or in unrolled mode. Second derivatives work.
/// A failure is reported as step() does, with the step, counted from 1. Also the torch op prdp::rollout.
SolveResult rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& steps,
                    const SolveOptions& options);

}  // namespace prdp
