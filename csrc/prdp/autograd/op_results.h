#pragma once
#include <tuple>
#include <utility>
#include <vector>

#include "prdp/solvers/solve.h"

/// What ops of torch return: solves with their reports as tuples, gradients as lists of those that are needed. And the
/// same without values, for fake tensors.
namespace prdp {

/// Of the gradients of all inputs, those that are `needed`, as an op returns them.
inline std::vector<at::Tensor> only_needed(const std::vector<at::Tensor>& gradients, at::IntArrayRef needed) {
  std::vector<at::Tensor> all;
  for (size_t i = 0; i < needed.size(); ++i)
    if (needed[i]) all.push_back(gradients[i]);
  return all;
}

/// The reverse: each in the place of its input.
inline std::vector<at::Tensor> in_places(const std::vector<at::Tensor>& gradients, at::IntArrayRef needed) {
  std::vector<at::Tensor> of_inputs(needed.size());
  for (size_t i = 0, next = 0; i < needed.size(); ++i)
    if (needed[i]) of_inputs[i] = gradients[next++];
  return of_inputs;
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

/// only_needed() of gradients without values: of an input of these sizes in the dtype of `like`, and of `tensors`.
inline std::vector<at::Tensor> empty_gradients(const at::Tensor& like, c10::SymIntArrayRef sizes,
                                               at::TensorList tensors, at::IntArrayRef needed) {
  std::vector<at::Tensor> all;
  if (needed[0]) all.push_back(at::empty_symint(sizes, like.options()));
  for (size_t i = 0; i < tensors.size(); ++i)
    if (needed[i + 1]) all.push_back(at::empty_symint(tensors[i].sym_sizes(), tensors[i].options()));
  return all;
}

/// A report of these sizes without values, in the dtype of `like`; of fake tensors, too.
inline SolveInfo empty_info(const at::Tensor& like, c10::SymIntArrayRef sizes) {
  const auto counts = [&] { return at::empty_symint(sizes, like.options().dtype(at::kLong)); };
  const auto numbers = [&] { return at::empty_symint(sizes, like.options()); };
  return {counts(), numbers(), counts(), counts(), numbers()};
}

}  // namespace prdp
