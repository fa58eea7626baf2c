#pragma once
#include <memory>

#include "prdp/operators/kinds.h"

namespace prdp {

/// `a`, a stencil, a matrix or a function, with its null spaces named: vectors that it maps to zero, (k, *shape) for
/// each channel of a vector (batch, channel, *shape), (k, channels, *shape) for all channels together, or the latter
/// for each sample, (batch, k, channels, *shape), of a matrix (batch, k, n); there a sample that has fewer has zeros.
/// And as many that Aᵀ maps to zero. Undefined: the constant of each channel; `left` is `right` if it is left out, as
/// of a symmetric A.
OperatorSpec with_null_space(OperatorSpec a, const at::Tensor& right = {}, std::optional<at::Tensor> left = {});

/// u, of least norm, with the part of its derivative that comes of the null space: where the basis N depends on
/// parameters, u̇ has the part -N (NᵀN)⁻¹ Ṅᵀ u beside that of b and A. `basis`: as SingularOperator's.
at::Tensor follow_null_space(const at::Tensor& u, const at::Tensor& basis);

/// v with the unknowns that a vector of a basis has as its last axis: those of a channel, or of all.
at::Tensor by_vector(const at::Tensor& v, bool spans_channels);

/// Orthonormal vectors of which no two have an entry at the same place, (n,) or (batch, n): the number of the vector
/// that has one there, and the entry, in double. Undefined where there are no such vectors.
struct DisjointVectors {
  at::Tensor vector, entry;
  explicit operator bool() const { return vector.defined(); }
};

/// A singular operator together with its null spaces, which its user names: vectors that A maps to zero (right), and
/// such that Aᵀ maps to zero (left). Right-hand sides and cotangents are projected onto what A, or Aᵀ, can reach, and
/// solutions onto those of least norm. A right-hand side with a part outside, beyond rtol, is INCONSISTENT. Its kind is
/// "singular_" and that of A; its tensors are those of A and the two bases.
class SingularOperator final : public Operator {
 public:
  /// `a` is the operator of `spec` without its null spaces. These are the last two tensors, as with_null_space() has
  /// them; an empty one is the constant of each channel. Raises ValueError if they do not fit each other.
  SingularOperator(std::unique_ptr<Operator> a, const OperatorSpec& spec);

  void check_vector(const at::Tensor& b) const override;
  void check_parameters(Checks checks) const override { a_->check_parameters(checks); }
  std::string refusal(int64_t sample) const override { return a_->refusal(sample); }
  /// Raises ValueError if A does not map the right, or Aᵀ the left basis to zero. Of the operator that this thread
  /// checked last, it is known.
  void check_null_spaces(const at::Tensor& b) const override;

  /// Without what rounding leaves along the null space, which would add up in the residuals that a method carries on;
  /// but for a null space that depends on parameters, along which the product has a derivative.
  at::Tensor apply(const at::Tensor& v) const override {
    return needs_derivative_ ? a_->apply(v) : project(a_->apply(v));
  }
  at::Tensor apply_transpose(const at::Tensor& v) const override {
    return needs_derivative_ ? a_->apply_transpose(v) : project_solution(a_->apply_transpose(v));
  }
  at::Tensor diagonal() const override { return a_->diagonal(); }
  at::Tensor norm() const override { return a_->norm(); }
  at::Tensor norm_of_transpose() const override { return a_->norm_of_transpose(); }
  at::Tensor project(const at::Tensor& v) const override { return without(left_, v); }
  at::Tensor project_solution(const at::Tensor& v) const override { return without(right_, v); }
  bool needs_projection() const override { return true; }
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  at::Tensor nonfinite_samples(const at::Tensor& b) const override { return a_->nonfinite_samples(b); }
  std::vector<int64_t> first_nonfinite(int64_t sample) const override { return a_->first_nonfinite(sample); }
  std::unique_ptr<Operator> select(const at::Tensor& index) const override;
  std::vector<int64_t> vector_shape() const override { return a_->vector_shape(); }
  bool has_coarse_grids() const override { return a_->has_coarse_grids(); }
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override;
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override;
  std::optional<kernels::FactorKey> key(bool transposed) const override;

 private:
  struct Basis {
    at::Tensor given;   // without a derivative
    at::Tensor source;  // what the spec has
    mutable at::Tensor orthonormal{};           // in double, once it has been asked for
    mutable std::optional<DisjointVectors> disjoint{};  // likewise; without vectors where they are not disjoint

    bool is_constant() const { return given.sym_numel() == 0; }
    /// Whether each sample of v has vectors of its own.
    bool is_of_samples(const at::Tensor& v) const { return !is_constant() && given.dim() == v.dim() + 1; }
    /// Whether its vectors are of all channels that v has.
    bool spans_channels(const at::Tensor& v) const { return !is_constant() && v.dim() > 2 && given.dim() >= v.dim(); }
    /// How many vectors there are: `axis` is 1 of those of samples, else 0.
    c10::SymInt count(int64_t axis) const { return is_constant() ? c10::SymInt(1) : given.sym_size(axis); }
  };

  void check_counts(const c10::SymInt& right, const c10::SymInt& left) const;
  /// Many vectors of which no two have an entry at the same place, such as those of the parts of a graph.
  const DisjointVectors& disjoint(const Basis& basis, const at::Tensor& v) const;
  /// An orthonormal basis (k, n), or (batch, k, n), in the dtype of v, with n the unknowns of a channel, or of all.
  at::Tensor orthonormal(const Basis& basis, const at::Tensor& v) const;
  at::Tensor without(const Basis& basis, const at::Tensor& v) const;
  /// `size`: how large an entry of a product can be, of each sample or of all.
  void check_is_mapped_to_zero(const Basis& basis, const at::Tensor& b, const at::Tensor& size, bool transposed) const;

  /// On other devices, a solve with a stencil that stencil_direct.h knows a cheap way for.
  std::optional<at::Tensor> solve_on_axes(const at::Tensor& b, bool transposed) const;

  std::unique_ptr<Operator> a_;
  OperatorSpec spec_;
  Basis right_, left_;
  bool needs_derivative_;  // a derivative with respect to a basis is asked for
  const char* title_;
};

}  // namespace prdp
