#pragma once
#include <string>

#include "prdp/solvers/failed_sample.h"

/// Whether A and a preconditioner of one's own are what a method is made for, as a few products tell.
namespace prdp {

/// Whether A is symmetric up to rounding; false where nobody knows, as of a function without a transpose.
bool is_symmetric(const FailedSample& sample);

/// Where A is not symmetric: that, in words. Else empty.
std::string asymmetric(const FailedSample& sample);

/// Where the method needs A, or a preconditioner of one's own, to be symmetric, or the latter to be linear, and it is
/// not: that, in words. Else empty.
std::string unfit(const FailedSample& sample);

/// Whether a preconditioner of one's own resembles A, where it should resemble its inverse.
bool preconditions_with_operator(const FailedSample& sample);

}  // namespace prdp
