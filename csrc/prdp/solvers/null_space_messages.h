#pragma once
#include <string>

#include "prdp/solvers/failed_sample.h"

/// What the messages of failed solves say of null spaces.
namespace prdp {

/// Where A maps the constant to zero, though nobody named its null space: that, in words. Else empty. Operators of the
/// library know their own.
std::string undeclared_null_space(const FailedSample& sample);

/// What of b A cannot reach, and what to do.
std::string inconsistent(const FailedSample& sample);

}  // namespace prdp
