#pragma once
#include <cstdint>

#include "prdp/solvers/sample_state.h"

/// A batch to solve as plain arrays: what the CPU loops and the kernels of a GPU are called with.
namespace prdp {

/// Where the reports of a batch go, (batch,) each.
template <class T>
struct ReportArrays {
  int64_t *iterations, *status, *applications;
  T *residual, *floor;

  void write(int64_t sample, const SampleOutcome& outcome) const {
    iterations[sample] = outcome.iterations;
    status[sample] = static_cast<int64_t>(outcome.status);
    applications[sample] = outcome.applications;
    residual[sample] = static_cast<T>(outcome.residual);
    floor[sample] = static_cast<T>(outcome.floor);
  }
};

template <class T>
struct GivenSample {
  const T *b, *x0;  // without a start, null
  T* u;
  T magnitude;  // of b
  int64_t cap;
  double rtol;
  bool guarded, whole_cycles;
};

template <class T>
struct BatchArrays {
  const T *b, *x0;      // (batch, unknowns); no start: null
  T* u;                 // (batch, unknowns)
  const int64_t* caps;  // (batch,); null: all have max_iter
  ReportArrays<T> report;
  int64_t max_iter;
  double rtol;
  bool guarded, whole_cycles;

  /// `magnitude`: of its b.
  GivenSample<T> sample(int64_t s, int64_t unknowns, T magnitude) const {
    const int64_t begin = s * unknowns;
    return {.b = b + begin,
            .x0 = x0 ? x0 + begin : nullptr,
            .u = u + begin,
            .magnitude = magnitude,
            .cap = caps ? caps[s] : max_iter,
            .rtol = rtol,
            .guarded = guarded,
            .whole_cycles = whole_cycles};
  }
};

}  // namespace prdp
