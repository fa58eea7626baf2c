#pragma once
#include <string>

#include "prdp/autograd/packed_options.h"
#include "prdp/steppers/equation.h"

/// An Equation as it crosses torch's dispatcher: five arguments of an op.
namespace prdp {

#define PRDP_EQUATION_SCHEMA "Tensor[] tensors, str kind, int[] shape, float[] parameters, int picard_steps"

/// The type of the kernel of an op with PRDP_EQUATION_SCHEMA behind the arguments of `Signature` and before `Back`.
template <class Signature, class... Back>
using WithEquation =
    Append<Signature, at::TensorList, c10::string_view, at::IntArrayRef, at::ArrayRef<double>, int64_t, Back...>;

/// kernel(equation, back...), the equation made of the five arguments of PRDP_EQUATION_SCHEMA.
template <class Kernel, class... Back>
auto with_equation(const Kernel& kernel, at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                   at::ArrayRef<double> parameters, int64_t picard_steps, const Back&... back) {
  return kernel(Equation{std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), picard_steps}, back...);
}

}  // namespace prdp
