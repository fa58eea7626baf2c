#pragma once
#include <cstdint>

/// What a method says of itself to the loop around it (iterate.h).
namespace prdp::detail {

/// GMRES in its two forms, not MINRES: each cycle takes the least residual over a space, which may be exhausted.
template <class Method>
inline constexpr bool kMayExhaust = requires(const Method& m) { m.exhausted(); };

/// Methods whose step takes several iterations: up to the next look, or all where nobody looks.
template <class Method>
inline constexpr bool kTakesStrides = requires(Method& m, int64_t n) { m.step(n); };

/// Methods whose residual may rise and fall for long on its way down.
template <class Method>
inline constexpr bool kOscillates = requires { Method::kOscillates; };

/// Methods whose residual never grows without a preconditioner, but for rounding.
template <class Method>
inline constexpr bool kNeverGrows = requires { Method::kNeverGrows; };

/// Methods that update their residual by a recursion, and go on from the true one once it is recomputed.
template <class Method>
inline constexpr bool kHasRecursiveResidual = requires { Method::kHasRecursiveResidual; };

/// Methods for definite operators: a truncated iterate may have a residual above ‖b‖ and still be nearer to the
/// solution than zero, in the norm of A.
template <class Method>
inline constexpr bool kDescendsEnergy = requires { Method::kDescendsEnergy; };

/// Methods whose one iteration solves.
template <class Method>
inline constexpr bool kIsExact = requires { Method::kIsExact; };

/// Methods whose every iteration takes about the same share off the error.
template <class Method>
inline constexpr bool kContracts = requires { Method::kContracts; };

}  // namespace prdp::detail
