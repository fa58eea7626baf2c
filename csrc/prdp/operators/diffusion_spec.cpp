#include <ATen/EmptyTensor.h>

#include <algorithm>
#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/operators/step_parameters.h"
#include "prdp/operators/tensors.h"

/// What a Diffusion is made of.
namespace prdp {

namespace {

/// `t` in this dtype; a number of the host without operations of torch, four of them, where autograd does not care.
at::Tensor in_dtype(const at::Tensor& t, at::ScalarType dtype) {
  if (t.scalar_type() == dtype) return t;
  if (t.dim() > 0 || !t.is_cpu() || !t.has_storage() || !is_plain(t) || t.requires_grad() || has_tangent(t))
    return t.to(dtype);
  auto number = at::detail::empty_cpu({}, dtype);
  if (dtype == at::kFloat) *number.mutable_data_ptr<float>() = static_cast<float>(number_of(t));
  else *number.mutable_data_ptr<double>() = number_of(t);
  return number;
}

/// One for each axis, where one for all was given.
template <class T>
std::vector<T> for_each_axis(const std::vector<T>& given, size_t axes, const char* what) {
  TORCH_CHECK_VALUE(given.size() == 1 || given.size() == axes, "Diffusion: ", what, " or ", axes,
                    ", one for each axis, got ", given.size());
  return given.size() == axes ? given : std::vector<T>(axes, given.front());
}

/// Whether t is (batch or 1, *sample).
bool is_batch_of(const at::Tensor& t, const std::vector<int64_t>& sample) {
  return t.dim() == 1 + static_cast<int64_t>(sample.size()) &&
         t.sym_sizes().slice(1) == c10::SymIntArrayRef(c10::fromIntArrayRefSlow(sample));
}

}  // namespace

std::vector<double> DiffusionOperator::Box::packed() const {
  std::vector<double> numbers;
  for (const auto& [low, high] : sides)
    numbers.insert(numbers.end(), {static_cast<double>(low), static_cast<double>(high)});
  numbers.insert(numbers.end(), lengths.begin(), lengths.end());
  numbers.push_back(static_cast<double>(mean));
  return numbers;
}

DiffusionOperator::Box DiffusionOperator::Box::unpacked(const std::vector<double>& numbers, size_t axes) {
  TORCH_CHECK_VALUE(numbers.size() == 3 * axes + 1, "Diffusion: expected ", 3 * axes + 1, " parameters, got ",
                    numbers.size());
  const auto code = [&](size_t i) { return static_cast<int>(numbers[i]); };
  Box box;
  for (size_t d = 0; d < axes; ++d)
    box.sides.push_back({static_cast<Side>(code(2 * d)), static_cast<Side>(code(2 * d + 1))});
  const auto first = numbers.begin() + static_cast<std::ptrdiff_t>(2 * axes);
  box.lengths.assign(first, first + static_cast<std::ptrdiff_t>(axes));
  box.mean = static_cast<FaceMean>(code(3 * axes));
  return box;
}

void DiffusionOperator::Box::check() const {
  for (const auto& [low, high] : sides)
    TORCH_CHECK_VALUE((low == Side::kPeriodic) == (high == Side::kPeriodic),
                      "Diffusion: both sides of an axis are periodic or none is");
  for (const double length : lengths)
    TORCH_CHECK_VALUE(std::isfinite(length) && length > 0.0, "Diffusion: length must be > 0, got ", length);
}

OperatorSpec diffusion(const at::Tensor& kappa, const at::Tensor& shift, const std::vector<Sides>& sides,
                       const std::vector<double>& lengths, FaceMean faces, const std::vector<at::Tensor>& robin,
                       bool per_axis) {
  TORCH_CHECK_VALUE(kappa.defined() && shift.defined(), "Diffusion: ", kappa.defined() ? "shift" : "kappa",
                    " is an undefined tensor");
  const int64_t axes = kappa.dim() - 1 - static_cast<int64_t>(per_axis);
  TORCH_CHECK_VALUE(axes >= 1 && axes <= 3, "Diffusion: kappa must have shape (batch or 1, ", per_axis ? "axes, " : "",
                    "*shape) with 1 to 3 axes in shape, got ", kappa.sizes());
  const auto count = static_cast<size_t>(axes);
  DiffusionOperator::Box box{{}, for_each_axis(lengths, count, "length must be one number"), faces};
  for (const auto& [low, high] : for_each_axis(sides, count, "boundary must be one for all axes"))
    box.sides.push_back({low, high});
  OperatorSpec spec{per_axis ? "diffusion_per_axis" : "diffusion",
                    kappa.sizes().slice(kappa.dim() - axes).vec(),
                    box.packed(),
                    {kappa, shift}};
  spec.tensors.insert(spec.tensors.end(), robin.begin(), robin.end());
  [[maybe_unused]] const DiffusionOperator checks_the_rest(spec);
  const auto holds = [](Side side) { return side == Side::kZero || side == Side::kRobin; };
  bool held = shift.dim() > 0 || shift.item<double>() != 0.0;
  for (const auto& axis : sides) held = held || holds(axis.low) || holds(axis.high);
  return held ? spec : with_null_space(std::move(spec), at::empty({0}, kappa.options()));
}

DiffusionOperator::DiffusionOperator(const OperatorSpec& spec)
    : shape_(spec.shape), per_axis_(spec.kind.ends_with("_per_axis")), names_null_space_(is_singular(spec)) {
  check_shapes(spec.tensors);
  const auto &kappa = spec.tensors[0], &shift = spec.tensors[1];
  kappa_ = per_axis_ ? kappa : kappa.unsqueeze(1);
  shift_ = in_dtype(shift, kappa.scalar_type());
  if (shift.dim() > 0) shift_ = shift_.unsqueeze(1);
  box_ = Box::unpacked(spec.parameters, shape_.size());
  box_.check();
  for (int64_t axis = 0; axis < dim(); ++axis)
    for (size_t end = 0; end < 2; ++end)
      if (box_.sides[axis][end] == Side::kRobin) take_robin(spec.tensors, axis, end);
  TORCH_CHECK_VALUE(spec.tensors.size() == 2 + robin_.size(), "Diffusion: takes h of each Robin side, ", robin_.size(),
                    " here, got ", spec.tensors.size() - 2);
}

void DiffusionOperator::check_shapes(const std::vector<at::Tensor>& tensors) const {
  TORCH_CHECK_VALUE(tensors.size() >= 2, "Diffusion: takes the tensors kappa, shift, and h of each Robin side");
  const auto &kappa = tensors[0], &shift = tensors[1];
  auto of_sample = shape_;
  if (per_axis_) of_sample.insert(of_sample.begin(), dim());
  TORCH_CHECK_VALUE(dim() >= 1 && dim() <= 3 && is_batch_of(kappa, of_sample),
                    "Diffusion: kappa must have shape (batch or 1, ", per_axis_ ? "axes, " : "", "*shape), got ",
                    kappa.sym_sizes());
  TORCH_CHECK_VALUE(std::all_of(shape_.begin(), shape_.end(), [](int64_t n) { return n >= 1; }),
                    "Diffusion: every extent of shape must be >= 1, got ", at::IntArrayRef(shape_));
  TORCH_CHECK_TYPE(kappa.scalar_type() == at::kFloat || kappa.scalar_type() == at::kDouble,
                   "Diffusion: kappa must be float32 or float64, got ", dtype_name(kappa.scalar_type()));
  TORCH_CHECK_VALUE(shift.dim() == 0 || is_batch_of(shift, shape_),
                    "Diffusion: shift must be a number or (batch or 1, *shape), got ", shift.sym_sizes());
}

void DiffusionOperator::take_robin(const std::vector<at::Tensor>& tensors, int64_t axis, size_t end) {
  TORCH_CHECK_VALUE(2 + robin_.size() < tensors.size(), "Diffusion: takes h of each Robin side, got ",
                    tensors.size() - 2);
  const auto& h = tensors[2 + robin_.size()];
  auto side = shape_;
  side.erase(side.begin() + axis);
  TORCH_CHECK_VALUE(h.dim() == 0 || is_batch_of(h, side), "Diffusion: h of the ", end == 0 ? "low" : "high",
                    " side of axis ", axis, " must be a number or have shape (batch or 1, *side), where side is ",
                    at::IntArrayRef(side), ", got ", h.sym_sizes());
  const auto taken = in_dtype(h, kappa_.scalar_type());
  robin_.push_back(h.dim() == 0 ? taken : taken.unsqueeze(1 + axis).unsqueeze(1));
}

}  // namespace prdp
