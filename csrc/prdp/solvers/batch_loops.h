#pragma once
#include <ATen/ATen.h>

#include <array>
#include <vector>

/// The operations of TensorSpace that an iteration spends its time on, by the loops of this processor: for a batch in
/// the host's memory that autograd does not record. A plain tensor operation takes a pass over memory of its own for
/// each product and sum.
///
/// A vector is written in place unless somebody else refers to its memory, such as a product that keeps what it was
/// given. Numbers are (batch, 1, …), as those of TensorSpace. `active` is empty where every sample is.
namespace prdp::batch_loops {

using Vector = at::Tensor;
using Scalar = at::Tensor;
using Active = std::vector<bool>;

/// Whether they can take vectors like b.
bool take(const at::Tensor& b);
/// While it exists, they take none on this thread: tests compare them with tensor operations.
class Off {
 public:
  Off();
  Off(const Off&) = delete;
  ~Off();
};

Scalar dot(const Vector& a, const Vector& b);
/// max |v| of each sample, (batch,); NaN or Inf if any entry is.
at::Tensor largest_magnitude(const Vector& v);
/// out = factor v, of all samples; and the same in one pass with w·out and ‖out‖².
void scale(const Scalar& factor, const Vector& v, Vector& out);
std::array<Scalar, 2> scale_with_dots(const Scalar& factor, const Vector& v, const Vector& w, Vector& out);
/// y = x + beta y
void xpby(const Vector& x, const Scalar& beta, Vector& y, const Active& active);
/// x += alpha p and r -= alpha q; returns ‖r‖².
Scalar update_iterate_and_residual(const Scalar& alpha, const Vector& p, const Vector& q, Vector& x, Vector& r,
                                   const Active& active);
/// x += Σ h_i v_i over the first `count` of v.
void add_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, Vector& x, const Active& active);
/// A step of Gram–Schmidt, twice: h_i = v_i·w for i ≤ j, and w ← w - Σ h_i v_i; then h_{j+1} = ‖w‖, and v_{j+1} =
/// w/max(‖w‖, least) if there is such a row. v: (m, batch, …); h: j + 2 numbers of each sample, null where v_{j+1}
/// shall be zero.
void orthogonalise(const at::Tensor& v, int64_t j, double least, Vector& w, const std::vector<double*>& h);
/// Σ y_i v_i, for y (batch, m, 1) in float64.
Vector combination(const at::Tensor& v, const at::Tensor& y);

/// Whether a number is not zero.
bool any(const Scalar& where);
/// The rules of SampleNumbers, for each sample.
Scalar sum_of_squares(const Scalar& v2, const Scalar& a, const Scalar& w2);
Scalar ratio(const Scalar& num, const Scalar& den);
Scalar breaks_down(const Scalar& den, const Scalar& v2, const Scalar& w2, const Scalar& active);
struct Quotient {
  Scalar value;
  at::Tensor breaks;  // the samples that break down; undefined: none
};
Quotient guarded_quotient(const Scalar& num, const Scalar& den, const Scalar& v2, const Scalar& w2);

}  // namespace prdp::batch_loops
