#pragma once
#include "prdp/kernels/laplacian_parameters.h"
#include "prdp/operators/operator.h"
#include "prdp/solvers/sample_loop.h"

namespace prdp {

/// Solves the samples [begin, end) of a batch; one translation unit a kind of operator.
template <class T>
void solve_range(const kernels::LaplacianParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void solve_range(const DenseParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void solve_range(const CsrParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void solve_range(const BurgersParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void solve_range(const NavierStokesParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end);
template <class T>
void solve_range(const StencilParameters& a, const SampleBatch<T>& batch, int64_t begin, int64_t end);

}  // namespace prdp
