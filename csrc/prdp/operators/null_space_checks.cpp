#include <ATen/core/grad_mode.h>

#include <limits>
#include <variant>

#include "prdp/error_text.h"
#include "prdp/kernels/kernel.h"
#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/probes.h"
#include "prdp/operators/remembered.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/operators/tensors.h"

/// What is refused of the null spaces that somebody named.
namespace prdp {

void SingularOperator::check_vector(const at::Tensor& b) const {
  a_->check_vector(b);
  for (const auto* side : {&right_, &left_}) {
    if (side->is_constant()) continue;
    const auto& basis = side->given;
    const auto vector = b.sym_sizes().slice(1), channel = b.sym_sizes().slice(b.dim() < 3 ? 1 : 2);
    const auto given = basis.sym_sizes().slice(basis.dim() > 0);
    const bool of_samples = side->is_of_samples(b) && basis.sym_sizes().slice(2) == vector;
    TORCH_CHECK_VALUE(
        (basis.dim() >= 2 && (given == channel || given == vector)) || of_samples, title_,
        ": a null space must have shape (k, *shape) with the shape of a channel, ", channel,
        b.dim() < 3 ? "; or (batch, k, n)" : ", or (k, channels, *shape), or (batch, k, channels, *shape)", "; got ",
        basis.sym_sizes(),
        basis.sym_sizes() == channel || basis.sym_sizes() == vector ? "; give n.unsqueeze(0) for one vector n" : "");
    TORCH_CHECK_VALUE(!of_samples || basis.sym_size(0) == 1 || basis.sym_size(0) == b.sym_size(0), title_,
                      ": a null space of ", basis.sym_size(0), " samples, the vector has ", b.sym_size(0));
    TORCH_CHECK_VALUE(basis.device() == b.device(), title_, ": its null space is on ", basis.device(),
                      " but the vector is on ", b.device());
  }
  TORCH_CHECK_VALUE(right_.is_of_samples(b) == left_.is_of_samples(b), title_,
                    ": nullspace and left_nullspace must both be of each sample, or both of all samples");
  TORCH_CHECK_VALUE(right_.spans_channels(b) == left_.spans_channels(b), title_,
                    ": nullspace and left_nullspace must both be of one channel, or both of all channels");
  const int64_t axis = right_.is_of_samples(b);
  check_counts(right_.count(axis), left_.count(axis));
}

namespace {

/// ‖A‖∞ of each sample or of all, by the CPU loops where there are some.
at::Tensor norm_of(const Operator& a, const at::Tensor& b) {
  const auto kernels = b.is_cpu() ? a.kernels(b, /*transposed=*/false) : nullptr;
  if (!kernels) return a.norm().to(b.device(), at::kDouble);
  return std::visit(
      [&](const auto& batch) {
        std::vector<double> norms;
        for (int64_t s = 0; s < (batch.is_shared ? 1 : b.size(0)); ++s) {
          const auto kernel = batch.make(s);
          norms.push_back(kernel ? kernel->norm() / static_cast<double>(kernel->factor())
                                 : std::numeric_limits<double>::infinity());
        }
        return at::tensor(norms, at::kDouble);
      },
      kernels->of_dtype);
}

/// How large an entry of a product with numbers up to one can be, of each sample or of all: ‖A‖∞ or, of a Function,
/// whose norm is not known, what the product with signs without a pattern has.
at::Tensor size_of_products(const Operator& a, const at::Tensor& b) {
  const auto norm = norm_of(a, b);
  if (!norm.eq(0).all().item<bool>()) return norm;
  return sample_maxima(apply_on_loops(a, unstructured_like(b).sign().contiguous(), /*transposed=*/false));
}

}  // namespace

void SingularOperator::check_is_mapped_to_zero(const Basis& basis, const at::Tensor& b, const at::Tensor& size,
                                               bool transposed) const {
  const auto q = orthonormal(basis, b);
  const auto sizes = q.abs().amax(-1, /*keepdim=*/true);
  const auto vectors = q / sizes.masked_fill(sizes.eq(0), 1.0);
  const bool spans_channels = basis.spans_channels(b);
  const double rounding = 200.0 * epsilon_of(b);
  int64_t worst = 0;  // of the samples
  // The largest entry of a product: 0 where it is rounding or not finite; the sample's status reports the latter.
  const auto largest_of = [&](const at::Tensor& vector) {
    const auto v = basis.is_of_samples(b) ? vector.expand({b.size(0), -1}).reshape_as(b)
                                          : in_each_channel(vector, by_vector(b, spans_channels)).reshape_as(b);
    const auto left = sample_maxima(apply_on_loops(*a_, v, transposed));
    const auto wrong = (left > rounding * size).logical_and(left.isfinite());
    const auto of_samples = left.masked_fill(wrong.logical_not(), 0.0);
    worst = of_samples.argmax().item<int64_t>();
    return of_samples.amax().item<double>();
  };
  if (q.size(-2) > 1) {  // all of them by one product
    const auto sum = at::matmul(unlike_numbers(q.size(-2), q.options()), vectors);
    if (largest_of(sum / sum.abs().amax()) == 0.0) return;
  }
  for (int64_t k = 0; k < q.size(-2); ++k) {
    const double left = largest_of(vectors.select(-2, k));
    TORCH_CHECK_VALUE(
        left == 0.0, title_, ": vector ", k, " of ",
        in_language(transposed ? "left_nullspace" : "nullspace", transposed ? "the left ones" : "those"),
        basis.is_of_samples(b) ? c10::str(" of sample ", worst) : std::string(), " is not in the null space of ",
        transposed ? "Aᵀ" : "A", ": a product has entries of ", left, " where ‖v‖∞ is 1",
        transposed ? c10::str("; give ", in_language("left_nullspace=", "the left one, too,"), " if A is not symmetric")
                   : std::string(),
        !spans_channels && b.dim() > 2 && b.size(1) > 1
            ? "; it must be there in each channel alone: one of all channels has shape (1, channels, *shape)"
            : "",
        !basis.is_of_samples(b) && q.size(0) == b.size(0) && b.size(0) > 1
            ? c10::str("; all samples share these vectors: for one of each, give ",
                       b.dim() < 3 ? "(batch, 1, n)" : "(batch, 1, channels, *shape)")
            : std::string());
  }
}

void SingularOperator::check_null_spaces(const at::Tensor& b) const {
  static thread_local SpecFingerprint checked;
  if (b.numel() == 0 || checked.matches(spec_, b.scalar_type())) return;
  const at::NoGradGuard no_grad;
  a_->check_parameters(Checks::kShared);  // the products here are no kernel's
  if (right_.is_of_samples(b)) {
    const auto zeros = [&](const Basis& basis) { return orthonormal(basis, b).eq(0).all(-1); };
    TORCH_CHECK_VALUE(at::equal(zeros(right_), zeros(left_)), title_,
                      ": nullspace and left_nullspace must have their vectors of zeros at the same places");
  }
  const auto size = size_of_products(*a_, b);
  check_is_mapped_to_zero(right_, b, size, /*transposed=*/false);
  check_is_mapped_to_zero(left_, b, size, /*transposed=*/true);
  checked.store(spec_, b.scalar_type());
}

}  // namespace prdp
