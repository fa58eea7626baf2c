#pragma once
#include <bit>
#include <optional>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "prdp/solvers/solve.h"

/// SolveOptions and results as they cross torch's dispatcher: the options packed into four lists at the end of an op's
/// arguments, a result as a tuple.
namespace prdp {

#define PRDP_OPTIONS_SCHEMA "str[] names, SymInt[] counts, float[] numbers, Tensor[] preconditioner"

namespace detail {

template <class Signature>
struct AddOptions;
template <class Result, class... Front>
struct AddOptions<Result(Front...)> {
  using Type = Result(Front..., const c10::List<std::string>&, c10::SymIntArrayRef, at::ArrayRef<double>,
                      at::TensorList);
};

}  // namespace detail

/// The type of the kernel of an op whose schema ends in PRDP_OPTIONS_SCHEMA.
template <class Signature>
using WithOptions = typename detail::AddOptions<Signature>::Type;

/// The lists. Only this, unpack() and `packed_options` in prdp_torch/solvers.py know their order: change all three
/// together.
struct PackedOptions {
  explicit PackedOptions(const SolveOptions& o)
      : names({std::string(name(o.solver.method)), std::string(name(o.backward)), std::string(name(o.on_failure)),
               std::string(name(o.start)), o.solver.preconditioner.spec().kind}),
        counts{o.solver.max_iter,
               o.solver.restart,
               o.adjoint_log,
               o.checkpoint_every,
               static_cast<int64_t>(o.adjoint_max_iter.has_value()),
               o.adjoint_max_iter.value_or(0),
               static_cast<int64_t>(o.solver.preconditioner.spec().transposed),
               o.traced_rtol,
               o.traced_adjoint_rtol},
        numbers{o.solver.rtol, static_cast<double>(o.adjoint_rtol.has_value()), o.adjoint_rtol.value_or(0.0)},
        preconditioner(o.solver.preconditioner.spec().tensors) {
    const auto& m = o.solver.preconditioner.spec();
    counts.insert(counts.end(), m.shape.begin(), m.shape.end());
    numbers.insert(numbers.end(), m.parameters.begin(), m.parameters.end());
  }

  c10::List<std::string> names;
  std::vector<c10::SymInt> counts;
  std::vector<double> numbers;
  const std::vector<at::Tensor>& preconditioner;
};

namespace detail {

/// A tolerance may come as the integer of its bits instead, of which -1 is none: compiled graphs take an integer as it
/// is, and would have to be compiled again for each float.
template <class Number>
void take_bits(const c10::SymInt& bits, Number& tolerance, c10::SymInt& traced) {
  if (bits.is_symbolic()) traced = bits;
  else if (bits.expect_int() >= 0) tolerance = std::bit_cast<double>(bits.expect_int());
}

}  // namespace detail

/// Raises ValueError for names that do not exist, and for lists that are too short.
inline SolveOptions unpack(const c10::List<std::string>& names, c10::SymIntArrayRef counts,
                           at::ArrayRef<double> numbers, at::TensorList preconditioner) {
  constexpr size_t kNames = 5, kCounts = 9, kNumbers = 3;
  TORCH_CHECK_VALUE(names.size() == kNames && counts.size() >= kCounts && numbers.size() >= kNumbers,
                    "the options of a solve are ", kNames, " names, ", kCounts, " counts and ", kNumbers,
                    " numbers, got ", names.size(), ", ", counts.size(), " and ", numbers.size());
  OperatorSpec inverse{
      names.get(4), {}, numbers.slice(kNumbers).vec(), preconditioner.vec(), counts[6].expect_int() != 0};
  for (const auto& n : counts.slice(kCounts)) inverse.shape.push_back(n.expect_int());
  SolveOptions o{{method_from_name(names.get(0)), counts[0], numbers[0], counts[1].expect_int(), std::move(inverse)},
                 backward_from_name(names.get(1))};
  if (counts[4].expect_int() != 0) o.adjoint_max_iter = counts[5];
  if (numbers[1] != 0.0) o.adjoint_rtol = numbers[2];
  detail::take_bits(counts[7], o.solver.rtol, o.traced_rtol);
  detail::take_bits(counts[8], o.adjoint_rtol, o.traced_adjoint_rtol);
  o.on_failure = on_failure_from_name(names.get(2));
  o.adjoint_log = counts[2].expect_int();
  o.checkpoint_every = counts[3].expect_int();
  o.start = start_from_name(names.get(3));
  return o;
}

/// A tensor that may be undefined, as an op takes it.
using OptionalTensor = std::optional<at::Tensor>;
inline OptionalTensor or_none(const at::Tensor& t) { return t.defined() ? OptionalTensor(t) : std::nullopt; }

/// Calls an op through the dispatcher with `o` behind its other arguments.
template <class Op, class... Front>
auto call_with_options(const Op& op, const SolveOptions& o, const Front&... front) {
  const PackedOptions packed(o);
  return op.call(front..., packed.names, packed.counts, packed.numbers, packed.preconditioner);
}

/// A SolveResult as an op returns it, and back.
#define PRDP_REPORT_SCHEMA \
  "Tensor iterations, Tensor residual, Tensor status, Tensor operator_applications, Tensor floor"
using SolveOutputs = std::tuple<at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor>;
inline SolveOutputs outputs_of(SolveResult result) {
  auto& info = result.info;
  return {std::move(result.u),
          std::move(info.iterations),
          std::move(info.residual),
          std::move(info.status),
          std::move(info.operator_applications),
          std::move(info.floor)};
}
inline SolveResult result_of(SolveOutputs outputs) {
  auto& [u, iterations, residual, status, applications, floor] = outputs;
  return {std::move(u),
          {std::move(iterations), std::move(residual), std::move(status), std::move(applications), std::move(floor)}};
}

/// The same of fake tensors: a report of numbers of these sizes, in the dtype of `like`.
inline SolveInfo fake_info(const at::Tensor& like, c10::SymIntArrayRef sizes) {
  const auto counts = [&] { return at::empty_symint(sizes, like.options().dtype(at::kLong)); };
  const auto numbers = [&] { return at::empty_symint(sizes, like.options()); };
  return {counts(), numbers(), counts(), counts(), numbers()};
}

}  // namespace prdp
