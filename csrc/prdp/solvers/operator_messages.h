#pragma once
#include <string>

#include "prdp/solvers/failed_sample.h"

namespace prdp {

/// A cause that lies in A and makes any method fail with this status: empty or badly scaled rows and columns, a null
/// space that nobody named, a diffusion whose factors lose what holds u. In words; else empty.
std::string cause_in_operator(const FailedSample& sample, SolveStatus status);

}  // namespace prdp
