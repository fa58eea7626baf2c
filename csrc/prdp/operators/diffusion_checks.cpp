#include <ATen/Dispatch.h>
#include <ATen/TensorSubclassLikeUtils.h>

#include <algorithm>
#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/step_parameters.h"
#include "prdp/operators/tensors.h"

/// Which parameters a Diffusion refuses.
namespace prdp {

namespace {

constexpr const char* kNothingHolds = "neither the shift nor a side holds u, so A is singular";

/// A singular A that is meant.
std::string singular_if_meant() {
  return c10::str("; if that is meant, give ", in_language("shift=0.0", "0.0 as shift"),
                  ", a number, which makes the constant the null space of all samples");
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

const at::Tensor& DiffusionOperator::robin(int64_t axis, size_t end) const {
  size_t before = 0;
  for (int64_t d = 0; d < dim(); ++d)
    for (size_t e = 0; e < 2; ++e) {
      if (d == axis && e == end) return robin_[before];
      before += box_.sides[d][e] == Side::kRobin;
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
  return shape_[0] == dim() - 1 ? "; with per_axis=True, kappa has a field for each axis; species are samples" : "";
}

void DiffusionOperator::check_vector(const at::Tensor& b) const {
  TORCH_CHECK_VALUE(b.dim() == dim() + 2 && b.sym_sizes().slice(2) == kappa_.sym_sizes().slice(2) && b.sym_size(1) != 0,
                    "Diffusion: expected kappa (batch or 1, ", per_axis_ ? "axes, " : "",
                    "*shape) and b (batch, channel, *shape), got kappa ",
                    (per_axis_ ? kappa_ : kappa_.squeeze(1)).sym_sizes(), " and b ", b.sym_sizes(), remedy_for(b));
  for (const auto& [name, t] : tensors())
    TORCH_CHECK_VALUE(t.dim() == 0 || t.sym_size(0) == 1 || t.sym_size(0) == b.sym_size(0), "Diffusion: ", name,
                      " holds ", t.sym_size(0), " samples, the vector holds ", b.sym_size(0));
  TORCH_CHECK_TYPE(b.scalar_type() == kappa_.scalar_type(), "Diffusion: kappa is ", dtype_name(kappa_.scalar_type()),
                   " but the vector is ", dtype_name(b.scalar_type()));
  for (const auto& [name, t] : tensors())
    TORCH_CHECK_VALUE(t.device() == b.device() || (t.dim() == 0 && t.is_cpu()), "Diffusion: its tensors are on ",
                      t.device(), " but the vector is on ", b.device());
}

at::Tensor DiffusionOperator::unheld_samples() const {
  if (names_null_space_ || known_held_) return {};
  for (const auto& of_axis : box_.sides)
    if (of_axis[0] == Side::kZero || of_axis[1] == Side::kZero) return {};
  auto may_hold = robin_;
  may_hold.push_back(shift_);
  for (const auto& t : may_hold)
    if (t.dim() == 0 && t.is_cpu() && is_plain(t) && number_of(t) != 0.0) return {};
  at::Tensor unheld;
  for (const auto& t : may_hold) {
    const auto zero = zero_samples(t.detach()).to(kappa_.device());
    unheld = unheld.defined() ? unheld.logical_and(zero) : zero;
  }
  known_held_ = unheld.is_cpu() && is_plain(unheld) && !unheld.any().item<bool>();
  return known_held_ ? at::Tensor() : unheld;
}

at::Tensor DiffusionOperator::shift_or_nan() const {
  const auto unheld = unheld_samples();
  if (!unheld.defined()) return shift_;
  std::vector<int64_t> of_samples(shape_.size() + 2, 1), field{-1, 1};
  of_samples[0] = unheld.size(0);
  field.insert(field.end(), shape_.begin(), shape_.end());
  const auto added = at::zeros(of_samples, kappa_.options()).masked_fill(unheld.view(of_samples), NAN);
  return (shift_ + added).expand(field);
}

at::Tensor DiffusionOperator::nonfinite_samples(const at::Tensor& b) const {
  const auto nonfinite = Operator::nonfinite_samples(b), unheld = unheld_samples();
  return unheld.defined() ? nonfinite.logical_or(unheld) : nonfinite;
}

void DiffusionOperator::check_parameters(Checks checks) const {
  for (const auto& [name, t] : tensors())
    if (at::isTensorSubclassLike(t) || t.is_meta() || t.numel() == 0) return;  // no numbers, or none yet
  check_robin(checks);
  if (checks == Checks::kHost) return;
  if (checks == Checks::kAll) check_held();
  check_kappa(checks);
}

void DiffusionOperator::check_robin(Checks checks) const {
  for (const auto& h : robin_) {
    if (checks != Checks::kAll && (h.dim() > 0 || (checks == Checks::kHost && !h.is_cpu()))) continue;
    const double least = h.min().item<double>();
    TORCH_CHECK_VALUE(!(least < 0.0) && (h.dim() > 0 || std::isfinite(least)),
                      "Diffusion: h of a Robin side must be finite and >= 0, got ", least,
                      least > 0.0 ? "; \"zero\" holds u at 0 there" : "");
  }
}

void DiffusionOperator::check_held() const {
  const auto unheld = unheld_samples();
  if (!unheld.defined() || !unheld.any().item<bool>()) return;
  TORCH_CHECK_VALUE(false, "Diffusion: in sample ", first_true(unheld)[0], " ", kNothingHolds, singular_if_meant());
}

void DiffusionOperator::check_kappa(Checks checks) const {
  known_positive_ = kappa_.min().item<double>() > 0.0;
  if (known_positive_) return;
  const auto wrong = kappa_.le(0);
  if (checks == Checks::kShared || !wrong.any().item<bool>()) return;
  const auto index = first_true(wrong);
  const double value = kappa_.masked_select(wrong)[0].item<double>();
  TORCH_CHECK_VALUE(
      false, "Diffusion: kappa must be > 0, got ", value, " in sample ", index[0], " at index ",
      as_tuple(at::IntArrayRef(index).slice(per_axis_ ? 1 : 2)),
      value == 0.0
          ? "; where nothing flows, give 1e-12 times a typical one, with a side or a shift that holds each region"
          : "");
}

std::optional<DiffusionOperator::Refused> DiffusionOperator::first_refused(int64_t sample) const {
  for (const auto& [name, t] : tensors()) {
    if (t.dim() == 0) continue;
    const bool is_kappa = t.is_same(kappa_), is_shift = t.is_same(shift_);
    auto numbers = t.select(0, t.size(0) == 1 ? 0 : sample);
    if (!(is_kappa && per_axis_)) numbers = numbers.select(0, 0);
    auto wrong = nonfinite(numbers);
    // A shift is refused only where it is not finite, of which refusal() says more: its words below are never read.
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
    const auto unheld = unheld_samples();
    const bool is_unheld = unheld.defined() && unheld[unheld.size(0) == 1 ? 0 : sample].item<bool>();
    return is_unheld ? kNothingHolds + singular_if_meant() : "";
  }
  if (!std::isfinite(found->value)) return {};
  std::ostringstream text;
  text << found->must << ", got " << found->value << "; what a network predicts should end in exp or softplus";
  return text.str();
}

}  // namespace prdp
