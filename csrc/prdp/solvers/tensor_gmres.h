#pragma once
#include <ATen/ATen.h>

#include <cstdint>
#include <vector>

#include "prdp/kernels/whole_vectors.h"
#include "prdp/solvers/hessenberg_problem.h"
#include "prdp/solvers/tensor_space.h"

namespace prdp {

/// Numbers of one sample on the host, which vanish where those of its dtype would.
struct HostNumbers {
  using Scalar = double;
  double epsilon, negligible;

  /// Memory that is not touched: few columns of many may come.
  template <class X>
  kernels::Field<X> array(int64_t n) const {
    return kernels::Field<X>(n);
  }
  double inverse(double value, double scale) const;
  double larger(double a, double b) const { return a < b ? b : a; }
  double is_larger(double a, double b) const { return a > b; }
  double is_zero(double value) const { return value == 0.0; }
  double is_not_zero(double value) const { return value != 0.0; }
  bool surely_all(double value) const { return value != 0.0; }
  void damp(const double* r, const double* g, int64_t n, double scale, double keep, double* y) const;
};

/// GMRES(m) of a batch that autograd does not record: the cycles of GmresMethod, in a tenth of its operations. The
/// basis is one tensor. A pass of Gram–Schmidt, of which there are always two, is two batched products on a device, and
/// loops on the CPU. The host solves the small problem of the cycle, in float64: it looks at a device once before the
/// iterate moves, and once after.
class TensorGmres {
 public:
  TensorGmres(TensorSpace& space, int64_t restart);

  void start();
  void step();
  /// ‖b - A x‖². A cycle that made it grow was rounding errors and is taken back.
  at::Tensor residual2();
  at::Tensor recompute_residual();
  /// Not zero where the last cycle's Krylov space could not be extended: it holds all that A reaches.
  const at::Tensor& exhausted() const { return exhausted_; }

  at::Tensor x;

 private:
  /// v₀ = r/‖r‖ and A M⁻¹ v_j = Σ h_ij v_i
  void extend_basis();
  void orthogonalise_on_device(int64_t j, const at::Tensor& w);
  /// The same by loops; returns whether the cycle is over for all samples.
  bool orthogonalise_in_loops(int64_t j, at::Tensor& w);
  /// y = argmin ‖r - A M⁻¹ V y‖, (batch, m, 1) in float64; sets `exhausted`.
  at::Tensor minimise();

  /// The small problem of a sample.
  struct Cycle {
    HessenbergProblem<HostNumbers> problem;
    double length;  // ‖r‖
    int64_t columns = 0;
    bool has_ended() const { return columns > 0 && problem.ended(columns - 1) != 0.0; }
    double* next_column() { return problem.column(columns); }
    /// Takes it, once it is filled.
    void take_column();
  };
  void begin_cycles(const double* residual2);
  /// The columns that a device has filled.
  void take_columns_from_device();
  /// Row j of the basis, as a vector of the space.
  at::Tensor vector(int64_t j) const { return v_.select(0, j).view(space_.b().sizes()); }
  /// Rows 0 to j of each sample, (batch, j + 1, unknowns).
  at::Tensor rows(int64_t j) const { return v_.narrow(0, 0, j + 1).permute({1, 0, 2}); }

  TensorSpace& space_;
  int64_t m_;
  at::Tensor r_, kept_x_, kept_r_, residual2_, exhausted_;
  at::Tensor v_;               // (m, batch, unknowns), anew for each cycle
  at::Tensor h_;               // (batch, m + 1, m), on a device
  HostNumbers numbers_;
  std::vector<Cycle> cycles_;  // of each sample
  std::vector<double> scale_;  // of each sample, the largest ‖A v‖ so far: what is rounding beside it is zero
  bool is_first_ = true;       // the next cycle
  bool ready_ = false;         // r_ and residual2_ belong to x
  bool confirmed_ = true;      // and were computed from it: those of a start were not
};

}  // namespace prdp
