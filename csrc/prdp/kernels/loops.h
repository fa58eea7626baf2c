#pragma once
#include <cstdint>
#include <string_view>

/// The inner loops of all kernels. Their one source, loops.cpp, is compiled for several instruction
/// sets, and the best one that the processor has is chosen when they are first used.
namespace prdp::kernels {

/// Values that fill 64 bytes. Vectors are padded with zeros to a multiple of it, so that the compiler
/// may use whole vector registers, and sums run over as many partial sums whatever their width.
template <class T>
inline constexpr int64_t kLanes = 64 / static_cast<int64_t>(sizeof(T));

/// A stencil on one sample in padded rows: `row` values a row, `plane` a plane of `ny` rows. The
/// weights hold a row each (centre, then x, y, z), with zeros in the padding so that it stays zero.
template <class T>
struct PaddedStencil {
  int64_t ny, nz, row, plane;
  const T* weights;
};

template <class T>
struct Loops {
  const char* level;  // "baseline", "x86-64-v3", "x86-64-v4"

  /// Σ a_i b_i; any n.
  T (*dot)(const T* a, const T* b, int64_t n);
  /// y += alpha x; any n.
  void (*axpy)(T alpha, const T* x, T* y, int64_t n);
  /// y = x + beta y
  void (*xpby)(const T* x, T beta, T* y, int64_t n);
  /// x += alpha p and r -= alpha q in one pass; returns ‖r‖². p may be r itself. n: padded.
  T (*descend)(T alpha, const T* p, const T* q, T* x, T* r, int64_t n);

  /// By the number of dimensions less one. out = A v.
  void (*apply[3])(const PaddedStencil<T>& a, const T* v, T* out);
  /// y = c + (neighbours of x, weighted); the other one returns ‖y - x‖² as well.
  void (*sweep[3])(const PaddedStencil<T>& a, const T* c, const T* x, T* y);
  T (*sweep_and_measure[3])(const PaddedStencil<T>& a, const T* c, const T* x, T* y);
};

/// The loops for this processor; the environment variable PRDP_CPU_LEVEL asks for a lower level by its
/// name. Raises ValueError for a level that does not exist or that the processor lacks.
template <class T>
const Loops<T>& loops();
template <>
const Loops<float>& loops();
template <>
const Loops<double>& loops();

}  // namespace prdp::kernels
