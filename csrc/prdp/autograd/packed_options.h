#pragma once
#include <array>
#include <bit>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "prdp/operators/plain_tensors.h"
#include "prdp/solvers/solve.h"

/// SolveOptions as they cross torch's dispatcher: packed into four lists at the end of an op's arguments. What comes
/// back: op_results.h.
namespace prdp {

#define PRDP_OPTIONS_SCHEMA "str[] names, SymInt[] counts, float[] numbers, Tensor[] preconditioner"

namespace detail {

template <class Signature, class... Types>
struct AppendTypes;
template <class Result, class... Front, class... Types>
struct AppendTypes<Result(Front...), Types...> {
  using Type = Result(Front..., Types...);
};

}  // namespace detail

/// The type of a function that takes arguments of these types behind those of `Signature`.
template <class Signature, class... Types>
using Append = typename detail::AppendTypes<Signature, Types...>::Type;

/// The type of the kernel of an op whose schema ends in PRDP_OPTIONS_SCHEMA.
template <class Signature>
using WithOptions =
    Append<Signature, const c10::List<std::string>&, c10::SymIntArrayRef, at::ArrayRef<double>, at::TensorList>;

/// Where each option stands in its list. `packed_options` in prdp_torch/solvers.py writes the same lists: change both
/// together. An operator as preconditioner puts its tensors into the fourth list, and its shape and its parameters
/// behind the counts and the numbers.
namespace packed {

enum Name : size_t { kMethod, kBackward, kOnFailure, kStart, kPreconditioner, kNames };
enum Count : size_t {
  kMaxIter,
  kRestart,
  kAdjointLog,
  kCheckpointEvery,
  kHasAdjointMaxIter,
  kAdjointMaxIter,
  kIsPreconditionerTransposed,
  kRtolBits,  // the bit pattern of rtol; -1: see kRtol
  kAdjointRtolBits,
  kCounts
};
enum Number : size_t { kRtol, kHasAdjointRtol, kAdjointRtol, kNumbers };

}  // namespace packed

/// The lists of `o`, which must outlive them; unpack() is the inverse.
struct PackedOptions {
  explicit PackedOptions(const SolveOptions& o) : preconditioner(o.solver.preconditioner.spec().tensors) {
    using namespace packed;
    const auto& inverse = o.solver.preconditioner.spec();
    std::array<std::string, kNames> of_options;
    of_options[kMethod] = name(o.solver.method);
    of_options[kBackward] = name(o.backward);
    of_options[kOnFailure] = name(o.on_failure);
    of_options[kStart] = name(o.start);
    of_options[kPreconditioner] = inverse.kind;
    for (auto& one : of_options) names.push_back(std::move(one));

    counts.resize(kCounts);
    counts[kMaxIter] = o.solver.max_iter;
    counts[kRestart] = o.solver.restart;
    counts[kAdjointLog] = o.adjoint_log;
    counts[kCheckpointEvery] = o.checkpoint_every;
    counts[kHasAdjointMaxIter] = int64_t{o.adjoint_max_iter.has_value()};
    counts[kAdjointMaxIter] = o.adjoint_max_iter.value_or(0);
    counts[kIsPreconditionerTransposed] = int64_t{inverse.transposed};
    counts[kRtolBits] = o.traced_rtol;
    counts[kAdjointRtolBits] = o.traced_adjoint_rtol;
    counts.insert(counts.end(), inverse.shape.begin(), inverse.shape.end());

    numbers.resize(kNumbers);
    numbers[kRtol] = o.solver.rtol;
    numbers[kHasAdjointRtol] = o.adjoint_rtol.has_value() ? 1.0 : 0.0;
    numbers[kAdjointRtol] = o.adjoint_rtol.value_or(0.0);
    numbers.insert(numbers.end(), inverse.parameters.begin(), inverse.parameters.end());
  }

  c10::List<std::string> names;
  std::vector<c10::SymInt> counts;
  std::vector<double> numbers;
  const std::vector<at::Tensor>& preconditioner;
};

namespace detail {

/// Compiled graphs are specialised on floats but not on integers. So a tolerance may be passed as its bit pattern; -1:
/// none is.
template <class Number>
void take_bits(const c10::SymInt& bits, Number& tolerance, c10::SymInt& traced) {
  if (bits.is_symbolic()) traced = bits;
  else if (bits.expect_int() >= 0) tolerance = std::bit_cast<double>(bits.expect_int());
}

}  // namespace detail

/// Raises ValueError for names that do not exist, and for lists of a wrong length.
inline SolveOptions unpack(const c10::List<std::string>& names, c10::SymIntArrayRef counts,
                           at::ArrayRef<double> numbers, at::TensorList preconditioner) {
  using namespace packed;
  TORCH_CHECK_VALUE(names.size() == kNames && counts.size() >= kCounts && numbers.size() >= kNumbers,
                    "the options of a solve are ", int64_t{kNames}, " names, ", int64_t{kCounts}, " counts and ",
                    int64_t{kNumbers}, " numbers, got ", names.size(), ", ", counts.size(), " and ", numbers.size());
  const auto count = [&](Count which) { return counts[which].expect_int(); };
  OperatorSpec inverse{names.get(kPreconditioner),
                       {},
                       numbers.slice(kNumbers).vec(),
                       preconditioner.vec(),
                       count(kIsPreconditionerTransposed) != 0};
  for (const auto& n : counts.slice(kCounts)) inverse.shape.push_back(n.expect_int());

  SolveOptions o{{method_from_name(names.get(kMethod)), counts[kMaxIter]}, backward_from_name(names.get(kBackward))};
  o.solver.rtol = numbers[kRtol];
  o.solver.restart = count(kRestart);
  o.solver.preconditioner = std::move(inverse);
  if (count(kHasAdjointMaxIter) != 0) o.adjoint_max_iter = counts[kAdjointMaxIter];
  if (numbers[kHasAdjointRtol] != 0.0) o.adjoint_rtol = numbers[kAdjointRtol];
  detail::take_bits(counts[kRtolBits], o.solver.rtol, o.traced_rtol);
  detail::take_bits(counts[kAdjointRtolBits], o.adjoint_rtol, o.traced_adjoint_rtol);
  o.on_failure = on_failure_from_name(names.get(kOnFailure));
  o.adjoint_log = counts[kAdjointLog];
  o.checkpoint_every = count(kCheckpointEvery);
  o.start = start_from_name(names.get(kStart));
  return o;
}

/// A tensor that may be undefined, as an op takes it.
using OptionalTensor = std::optional<at::Tensor>;
inline OptionalTensor or_none(const at::Tensor& t) { return t.defined() ? OptionalTensor(t) : std::nullopt; }

/// Whether all tensors of a call are plain, so that it need not cross the dispatcher.
inline bool is_plain_call(const at::Tensor& v, at::TensorList tensors, const SolveOptions& o) {
  return is_plain(v) && all_plain(tensors) && all_plain(o.solver.preconditioner.spec().tensors);
}

/// Calls an op through the dispatcher with `o` behind its other arguments.
template <class Op, class... Front>
auto call_with_options(const Op& op, const SolveOptions& o, const Front&... front) {
  const PackedOptions packed(o);
  return op.call(front..., packed.names, packed.counts, packed.numbers, packed.preconditioner);
}

/// The operator, the options and the start of a solve, without b: what ops that solve or differentiate one take behind
/// arguments of their own.
struct SolveCall {
  OperatorSpec a;
  SolveOptions options;
  at::Tensor x0;
};

#define PRDP_SOLVE_SCHEMA \
  "Tensor[] tensors, str kind, int[] shape, float[] parameters, bool transposed, Tensor? x0, " PRDP_OPTIONS_SCHEMA

/// The type of the kernel of an op whose schema ends in PRDP_SOLVE_SCHEMA.
template <class Signature>
using WithSolve = WithOptions<Append<Signature, at::TensorList, c10::string_view, at::IntArrayRef, at::ArrayRef<double>,
                                     bool, const OptionalTensor&>>;

/// Raises as unpack() of its options.
template <class... Options>
SolveCall unpack_solve(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                       at::ArrayRef<double> parameters, bool transposed, const OptionalTensor& x0,
                       const Options&... options) {
  return {{std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), transposed},
          unpack(options...),
          x0.value_or(at::Tensor())};
}

template <class Op, class... Front>
auto call_with_solve(const Op& op, const OperatorSpec& a, const at::Tensor& x0, const SolveOptions& o,
                     const Front&... front) {
  return call_with_options(op, o, front..., a.tensors, a.kind, a.shape, a.parameters, a.transposed, or_none(x0));
}

}  // namespace prdp
