#pragma once
#include "prdp/steppers/equation.h"

namespace prdp {

/// Makes `steps` >= 0 steps in a row, as one node of autograd. Returns all states, u included,
/// (batch, steps + 1, channel, *shape), and a SolveInfo of tensors (batch, steps). Values and gradients equal those of
/// single calls of step() to the last bit. There is one backward pass, and its adjoint log holds tensors (batch, steps)
/// too. It needs the states if A depends on them or on a tensor that requires grad, and in unrolled mode. Second
/// derivatives work. Failures are reported as by step(), with the number of the step, counted from 1. Also the torch op
/// prdp::rollout.
SolveResult rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& steps,
                    const SolveOptions& options);

}  // namespace prdp
