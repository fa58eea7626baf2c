#include "prdp/solvers/null_space_messages.h"

#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/unnamed_null_space.h"

namespace prdp {

namespace {

/// Whether the null space of A is known: somebody named it, or it is that of a pressure.
bool knows_null_space(const FailedSample& sample) { return is_singular(sample.role.a) || sample.has_pressure(); }

enum class Of { kForwardA, kItsTranspose };
enum class Constant { kOfAllChannels, kOfEachChannel };

/// Whether A of the forward solve, or its transpose, maps the constant to zero.
bool maps_constant(const FailedSample& sample, Of of, Constant constant) {
  const bool transposed = (of == Of::kItsTranspose) != sample.role.adjoint;
  const bool jointly = constant == Constant::kOfAllChannels;
  return maps_constant_to_zero(sample.a, sample.b, transposed, jointly)[sample.index].item<bool>();
}

/// How to name a null space, where A, or Aᵀ, maps the constant to zero: that of each channel, or of all together.
std::string remedy_by_naming(const FailedSample& sample) {
  const auto& b = sample.b;
  const bool of_a = maps_constant(sample, Of::kForwardA, Constant::kOfAllChannels),
             of_transpose = maps_constant(sample, Of::kItsTranspose, Constant::kOfAllChannels);
  if (of_a != of_transpose)
    return c10::str("name both null spaces", in_language(": ", " by prdp::with_null_space(a, right, left): "),
                    of_a ? in_language("nullspace=\"constant\", and as left_nullspace the vector that Aᵀ maps to zero",
                                       "the right one is the constant, the left one what Aᵀ maps to zero")
                         : in_language("left_nullspace=\"constant\", and as nullspace the vector that A maps to zero",
                                       "the left one is the constant, the right one what A maps to zero"));
  const bool of_each_channel =
      b.dim() < 3 || b.size(1) == 1 || maps_constant(sample, Of::kItsTranspose, Constant::kOfEachChannel);
  if (of_each_channel)
    return c10::str("give ", in_language("nullspace=\"constant\" to the operator", "prdp::with_null_space(a)"),
                    ", or all vectors if it maps more to zero");
  return c10::str("give that of all channels together as a vector, ",
                  in_language("nullspace=torch.ones", "prdp::with_null_space(a, at::ones"), "(1, ",
                  c10::Join(", ", b.sizes().slice(1)), ")", in_language("", ")"), " in the dtype of b");
}

/// A small shift may make A regular, and be rounding beside the rest of the diagonal.
const char* or_lost_shift(const FailedSample& sample) {
  return sample.b.scalar_type() == at::kFloat ? "; if a shift is to hold it, float32 has lost that: take float64" : "";
}

/// Where nobody named the null space.
std::string inconsistent_unnamed(const FailedSample& sample) {
  const auto remedy = remedy_by_naming(sample) + or_lost_shift(sample);
  if (sample.role.adjoint)
    return "the cotangent has a constant part, which Aᵀ cannot reach, as A maps the constant to zero; " + remedy;
  return "b has a constant part, which A cannot reach, as Aᵀ maps the constant to zero; take the mean off b, and " +
         remedy;
}

/// Whether each channel of this vector is a constant.
bool is_constant(const at::Tensor& v) {
  const auto channels = v.dim() > 1 ? v.flatten(1) : v.unsqueeze(0);
  return norm_of(channels - channels.mean(1, /*keepdim=*/true)) <= std::sqrt(epsilon_of(v)) * norm_of(v);
}

}  // namespace

std::string undeclared_null_space(const FailedSample& sample) {
  if (!sample.a.may_be_singular() || knows_null_space(sample)) return {};
  const bool adjoint = sample.role.adjoint;
  if (!maps_constant(sample, adjoint ? Of::kItsTranspose : Of::kForwardA, Constant::kOfAllChannels)) return {};
  return c10::str(adjoint ? "Aᵀ" : "A", " maps the constant to zero, so ", adjoint ? "A" : "it", " is singular; ",
                  remedy_by_naming(sample), or_lost_shift(sample));
}

std::string inconsistent(const FailedSample& sample) {
  if (!knows_null_space(sample)) return inconsistent_unnamed(sample);
  const auto b = sample.of(sample.b), outside = b - sample.of(sample.a.project(sample.b));
  const double percent = 100.0 * norm_of(outside) / norm_of(b);
  const auto share = three_digits(percent) + " % of ";
  if (!sample.has_pressure()) {
    const char* again =
        percent < 1.0 ? "; if you did, take it off again, as the rounding of a large mean leaves a part" : "";
    return c10::str(share, "b lies outside the range of A; ",
                    is_constant(outside) ? "take the mean off b" : "take a b without that part",
                    is_constant(outside) ? again : "");
  }
  if (sample.role.adjoint)
    return share +
           "the cotangent is the mean of its pressure, which the step leaves free; take the mean off the "
           "pressure that the loss is made of";
  return share + "b is the mean of its pressure channel, which no flow can have; take it off";
}

}  // namespace prdp
