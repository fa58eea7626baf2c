#include <ATen/Dispatch.h>
#include <ATen/EmptyTensor.h>
#include <ATen/TensorSubclassLikeUtils.h>

#include <algorithm>
#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/operators/step_parameters.h"
#include "prdp/operators/tensors.h"

/// What a Diffusion is made of, what of it is refused, and what it warns of.
namespace prdp {

namespace {

constexpr const char* kUnheld = "neither the shift nor a side holds u, so A is singular";

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

/// Which samples of a number or a field are zero throughout: (batch or 1).
at::Tensor zero_samples(const at::Tensor& t) {
  if (t.dim() == 0) return t.eq(0).view({1});
  if (!t.is_cpu() || !is_plain(t) || !t.is_contiguous()) return t.eq(0).flatten(1).all(1);
  auto zero = at::empty({t.size(0)}, at::kBool);  // in one pass, which ends where it finds a number
  AT_DISPATCH_FLOATING_TYPES(t.scalar_type(), "zero_samples", [&] {
    const int64_t length = t.numel() / std::max<int64_t>(t.size(0), 1);
    for (int64_t s = 0; s < t.size(0); ++s) {
      const auto* first = t.const_data_ptr<scalar_t>() + s * length;
      zero.mutable_data_ptr<bool>()[s] = std::all_of(first, first + length, [](scalar_t x) { return x == 0; });
    }
  });
  return zero;
}

}  // namespace

OperatorSpec diffusion(const at::Tensor& kappa, const at::Tensor& shift, const std::vector<Sides>& sides,
                       const std::vector<double>& lengths, FaceMean faces, const std::vector<at::Tensor>& robin,
                       bool per_axis) {
  TORCH_CHECK_VALUE(kappa.defined() && shift.defined(), "Diffusion: ", kappa.defined() ? "shift" : "kappa",
                    " is an undefined tensor");
  const int64_t axes = kappa.dim() - 1 - static_cast<int64_t>(per_axis);
  TORCH_CHECK_VALUE(axes >= 1 && axes <= 3, "Diffusion: kappa must have shape (batch or 1, ", per_axis ? "axes, " : "",
                    "*shape) with 1 to 3 axes in shape, got ", kappa.sizes());
  const auto dim = static_cast<size_t>(axes);
  TORCH_CHECK_VALUE(sides.size() == 1 || sides.size() == dim, "Diffusion: boundary must be one for all axes or ", dim,
                    ", one for each, got ", sides.size());
  TORCH_CHECK_VALUE(lengths.size() == 1 || lengths.size() == dim, "Diffusion: length must be one number or ", dim,
                    ", one for each axis, got ", lengths.size());
  OperatorSpec spec{
      per_axis ? "diffusion_per_axis" : "diffusion", kappa.sizes().slice(kappa.dim() - axes).vec(), {}, {kappa, shift}};
  spec.tensors.insert(spec.tensors.end(), robin.begin(), robin.end());
  for (size_t d = 0; d < dim; ++d) {
    const auto& [low, high] = sides[sides.size() == 1 ? 0 : d];
    spec.parameters.insert(spec.parameters.end(), {static_cast<double>(low), static_cast<double>(high)});
  }
  for (size_t d = 0; d < dim; ++d) spec.parameters.push_back(lengths[lengths.size() == 1 ? 0 : d]);
  spec.parameters.push_back(static_cast<double>(faces));
  [[maybe_unused]] const DiffusionOperator checks_the_rest(spec);
  bool held = shift.dim() > 0 || shift.item<double>() != 0.0;
  for (const auto& axis : sides)
    for (const auto side : {axis.low, axis.high}) held = held || side == Side::kZero || side == Side::kRobin;
  if (held) return spec;
  return with_null_space(std::move(spec), at::empty({0}, kappa.options()));
}

DiffusionOperator::DiffusionOperator(const OperatorSpec& spec)
    : shape_(spec.shape), per_axis_(spec.kind.ends_with("_per_axis")), names_null_space_(is_singular(spec)) {
  TORCH_CHECK_VALUE(spec.tensors.size() >= 2, "Diffusion: takes the tensors kappa, shift, and h of each Robin side");
  const auto &kappa = spec.tensors[0], &shift = spec.tensors[1];
  auto of_sample = shape_;
  if (per_axis_) of_sample.insert(of_sample.begin(), dim());
  TORCH_CHECK_VALUE(dim() >= 1 && dim() <= 3 && kappa.dim() == 1 + static_cast<int64_t>(of_sample.size()) &&
                        kappa.sym_sizes().slice(1) == c10::SymIntArrayRef(c10::fromIntArrayRefSlow(of_sample)),
                    "Diffusion: kappa must have shape (batch or 1, ", per_axis_ ? "axes, " : "", "*shape), got ",
                    kappa.sym_sizes());
  TORCH_CHECK_VALUE(std::all_of(shape_.begin(), shape_.end(), [](int64_t n) { return n >= 1; }),
                    "Diffusion: every extent of shape must be >= 1, got ", at::IntArrayRef(shape_));
  TORCH_CHECK_TYPE(kappa.scalar_type() == at::kFloat || kappa.scalar_type() == at::kDouble,
                   "Diffusion: kappa must be float32 or float64, got ", kappa.scalar_type());
  TORCH_CHECK_VALUE(
      shift.dim() == 0 || (shift.dim() == dim() + 1 &&
                           shift.sym_sizes().slice(1) == c10::SymIntArrayRef(c10::fromIntArrayRefSlow(shape_))),
      "Diffusion: shift must be a number or (batch or 1, *shape), got ", shift.sym_sizes());
  kappa_ = per_axis_ ? kappa : kappa.unsqueeze(1);
  shift_ = in_dtype(shift, kappa.scalar_type());
  if (shift.dim() > 0) shift_ = shift_.unsqueeze(1);
  const auto axes = static_cast<size_t>(dim());
  TORCH_CHECK_VALUE(spec.parameters.size() == 3 * axes + 1, "Diffusion: expected ", 3 * axes + 1, " parameters, got ",
                    spec.parameters.size());
  for (size_t d = 0; d < axes; ++d) {
    sides_.push_back({static_cast<Side>(static_cast<int>(spec.parameters[2 * d])),
                      static_cast<Side>(static_cast<int>(spec.parameters[2 * d + 1]))});
    TORCH_CHECK_VALUE((sides_[d][0] == Side::kPeriodic) == (sides_[d][1] == Side::kPeriodic),
                      "Diffusion: both sides of an axis are periodic or none is");
    lengths_.push_back(spec.parameters[2 * axes + d]);
    TORCH_CHECK_VALUE(std::isfinite(lengths_[d]) && lengths_[d] > 0.0, "Diffusion: length must be > 0, got ",
                      lengths_[d]);
  }
  mean_ = static_cast<FaceMean>(static_cast<int>(spec.parameters.back()));
  for (int64_t axis = 0; axis < dim(); ++axis)
    for (size_t end = 0; end < 2; ++end)
      if (sides_[axis][end] == Side::kRobin) take_robin(spec.tensors, axis, end);
  TORCH_CHECK_VALUE(spec.tensors.size() == 2 + robin_.size(), "Diffusion: takes h of each Robin side, ", robin_.size(),
                    " here, got ", spec.tensors.size() - 2);
}

void DiffusionOperator::take_robin(const std::vector<at::Tensor>& tensors, int64_t axis, size_t end) {
  TORCH_CHECK_VALUE(2 + robin_.size() < tensors.size(), "Diffusion: takes h of each Robin side, got ",
                    tensors.size() - 2);
  const auto& h = tensors[2 + robin_.size()];
  auto side = shape_;
  side.erase(side.begin() + axis);
  const auto whole = c10::fromIntArrayRefSlow(side);
  TORCH_CHECK_VALUE(h.dim() == 0 || (h.dim() == dim() && h.sym_sizes().slice(1) == c10::SymIntArrayRef(whole)),
                    "Diffusion: h of the ", end == 0 ? "low" : "high", " side of axis ", axis,
                    " must be a number or have shape (batch or 1, *side), where side is ", at::IntArrayRef(side),
                    ", got ", h.sym_sizes());
  const auto taken = in_dtype(h, kappa_.scalar_type());
  robin_.push_back(h.dim() == 0 ? taken : taken.unsqueeze(1 + axis).unsqueeze(1));
}

const at::Tensor& DiffusionOperator::robin(int64_t axis, size_t end) const {
  size_t before = 0;
  for (int64_t d = 0; d < dim(); ++d)
    for (size_t e = 0; e < 2; ++e) {
      if (d == axis && e == end) return robin_[before];
      before += sides_[d][e] == Side::kRobin;
    }
  TORCH_INTERNAL_ASSERT(false);
}

std::vector<std::pair<const char*, at::Tensor>> DiffusionOperator::tensors() const {
  std::vector<std::pair<const char*, at::Tensor>> all{{"kappa", kappa_}, {"shift", shift_}};
  for (const auto& h : robin_) all.emplace_back("h of a Robin side", h);
  return all;
}

/// What may be meant by an axis too many.
std::string DiffusionOperator::remedy_for(const at::Tensor& b) const {
  if (per_axis_ || dim() != b.dim() - 1) return "";
  if (shape_[0] == 1) return "; kappa has no channel axis: take kappa[:, 0]";
  return shape_[0] == dim() - 1 ? "; with per_axis=True, kappa has a field for each axis" : "";
}

void DiffusionOperator::check_vector(const at::Tensor& b) const {
  TORCH_CHECK_VALUE(b.dim() == dim() + 2 && b.sym_sizes().slice(2) == kappa_.sym_sizes().slice(2) && b.sym_size(1) != 0,
                    "Diffusion: expected kappa (batch or 1, ", per_axis_ ? "axes, " : "",
                    "*shape) and b (batch, channel, *shape), got kappa ",
                    (per_axis_ ? kappa_ : kappa_.squeeze(1)).sym_sizes(), " and b ", b.sym_sizes(), remedy_for(b));
  for (const auto& [name, t] : tensors())
    TORCH_CHECK_VALUE(t.dim() == 0 || t.sym_size(0) == 1 || t.sym_size(0) == b.sym_size(0), "Diffusion: ", name,
                      " holds ", t.sym_size(0), " samples, the vector holds ", b.sym_size(0));
  TORCH_CHECK_TYPE(b.scalar_type() == kappa_.scalar_type(), "Diffusion: kappa is ", kappa_.scalar_type(),
                   " but the vector is ", b.scalar_type());
  for (const auto& [name, t] : tensors())
    TORCH_CHECK_VALUE(t.device() == b.device() || (t.dim() == 0 && t.is_cpu()), "Diffusion: its tensors are on ",
                      t.device(), " but the vector is on ", b.device());
}

at::Tensor DiffusionOperator::unheld() const {
  if (names_null_space_ || known_held_) return {};
  for (const auto& of_axis : sides_)
    if (of_axis[0] == Side::kZero || of_axis[1] == Side::kZero) return {};
  auto holds = robin_;
  holds.push_back(shift_);
  for (const auto& t : holds)
    if (t.dim() == 0 && t.is_cpu() && is_plain(t) && number_of(t) != 0.0) return {};
  at::Tensor lost;
  for (const auto& t : holds) {
    const auto zero = zero_samples(t.detach()).to(kappa_.device());
    lost = lost.defined() ? lost.logical_and(zero) : zero;
  }
  known_held_ = lost.is_cpu() && is_plain(lost) && !lost.any().item<bool>();
  return known_held_ ? at::Tensor() : lost;
}

at::Tensor DiffusionOperator::shift_or_nan() const {
  const auto lost = unheld();
  if (!lost.defined()) return shift_;
  std::vector<int64_t> of_samples(shape_.size() + 2, 1), field{-1, 1};
  of_samples[0] = lost.size(0);
  field.insert(field.end(), shape_.begin(), shape_.end());
  const auto added = at::zeros(of_samples, kappa_.options()).masked_fill(lost.view(of_samples), NAN);
  return (shift_ + added).expand(field);
}

at::Tensor DiffusionOperator::nonfinite_samples(const at::Tensor& b) const {
  const auto nonfinite = Operator::nonfinite_samples(b), lost = unheld();
  return lost.defined() ? nonfinite.logical_or(lost) : nonfinite;
}

void DiffusionOperator::check_parameters(Checks checks) const {
  for (const auto& [name, t] : tensors())
    if (at::isTensorSubclassLike(t) || t.is_meta() || t.numel() == 0) return;  // no numbers, or none yet
  for (const auto& h : robin_) {
    if (checks != Checks::kAll && (h.dim() > 0 || (checks == Checks::kHost && !h.is_cpu()))) continue;
    const double least = h.min().item<double>();
    TORCH_CHECK_VALUE(!(least < 0.0) && (h.dim() > 0 || std::isfinite(least)),
                      "Diffusion: h of a Robin side must be finite and >= 0, got ", least);
  }
  if (checks == Checks::kHost) return;
  if (const auto lost = checks == Checks::kAll ? unheld() : at::Tensor(); lost.defined() && lost.any().item<bool>())
    TORCH_CHECK_VALUE(false, "Diffusion: in sample ", first_true(lost)[0], " ", kUnheld, "; if that is meant, give ",
                      in_language("shift=0.0", "0.0 as shift"),
                      ", a number, which makes the constant the null space of all samples");
  known_positive_ = kappa_.min().item<double>() > 0.0;
  if (known_positive_) return;
  const auto wrong = kappa_.le(0);
  if (checks == Checks::kShared || !wrong.any().item<bool>()) return;
  const auto index = first_true(wrong);
  TORCH_CHECK_VALUE(false, "Diffusion: kappa must be > 0, got ",
                    kappa_.flatten()[wrong.flatten().to(at::kByte).argmax().item<int64_t>()].item<double>(),
                    " in sample ", index[0], " at index ", at::IntArrayRef(index).slice(per_axis_ ? 1 : 2));
}

std::optional<DiffusionOperator::Refused> DiffusionOperator::first_refused(int64_t sample) const {
  for (const auto& [name, t] : tensors()) {
    if (t.dim() == 0) continue;
    const bool is_kappa = t.is_same(kappa_), is_shift = t.is_same(shift_);
    auto numbers = t.select(0, t.size(0) == 1 ? 0 : sample);
    if (!(is_kappa && per_axis_)) numbers = numbers.select(0, 0);
    auto wrong = nonfinite(numbers);
    if (!is_shift) wrong = wrong.logical_or(is_kappa ? numbers.le(0) : numbers.lt(0));
    if (!wrong.any().item<bool>()) continue;
    return Refused{is_kappa ? "kappa must be > 0" : "h of a Robin side must be >= 0",
                   numbers.masked_select(wrong)[0].item<double>(), first_true(wrong)};
  }
  return std::nullopt;
}

std::vector<int64_t> DiffusionOperator::first_nonfinite(int64_t sample) const {
  const auto found = first_refused(sample);
  return found ? found->index : std::vector<int64_t>{};
}

std::string DiffusionOperator::refusal(int64_t sample) const {
  const auto found = first_refused(sample);
  if (!found) {
    const auto lost = unheld();
    return lost.defined() && lost[lost.size(0) == 1 ? 0 : sample].item<bool>() ? kUnheld : "";
  }
  if (!std::isfinite(found->value)) return {};
  std::ostringstream text;
  text << found->must << ", got " << found->value;
  return text.str();
}

}  // namespace prdp
