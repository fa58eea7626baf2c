#include "prdp/solvers/tensor_space.h"

#include <algorithm>
#include <utility>

#include "prdp/error_text.h"
#include "prdp/operators/probes.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/prepared_batch.h"
#include "prdp/solvers/sample_numbers.h"

namespace prdp {

TensorSpace::TensorSpace(System& system, at::Tensor b, States& states, bool recording)
    : system_(system),
      b_(recording || !b.is_cpu() ? std::move(b) : b.contiguous()),
      states_(states),
      recording_(recording) {
  in_loops_ = !recording_ && batch_loops::take(b_);
  b2_ = dot(b_, b_);
  negligible_ = limits_of(b_).least_normal / limits_of(b_).epsilon;
}

void TensorSpace::start_from(at::Tensor x, at::Tensor r) {
  start_ = std::move(x);
  given_b_ = std::exchange(b_, laid_out(r));
  b2_ = dot(b_, b_);
}

double TensorSpace::unit_roundoff() const { return limits_of(b_).epsilon / 2; }

const at::Tensor& TensorSpace::diagonal() {
  if (!diagonal_.defined()) {
    auto d = system_.a.diagonal();
    d = is_number_of_host(d) ? at::full({}, d.item(), b_.options()) : d.to(b_.options());
    diagonal_ = at::where(d.eq(0), at::ones_like(d), d);
  }
  return diagonal_;
}

void TensorSpace::define_scale(const Vector& product, const Vector& v, at::Tensor& scale) const {
  if (scale.defined()) return;
  const auto magnitude = [](const Vector& t) { return per_sample(largest_magnitude(t), t); };
  const auto of_product = magnitude(product), of_v = magnitude(v);
  const auto usable = of_product.gt(0).logical_and(of_product.isfinite()).logical_and(of_v.gt(0));
  const auto one = at::ones_like(of_v);
  scale = power_of_two_scale(at::where(usable, of_product, one)) / power_of_two_scale(at::where(usable, of_v, one));
  if (recording_) check_scale(scale);
}

/// A derivative meets the square of the scale, which must not underflow.
void TensorSpace::check_scale(const at::Tensor& scale) const {
  const auto exponent = scale.detach().log2().abs().amax().item<double>();
  const double most = b_.scalar_type() == at::kFloat ? 60.0 : 500.0;
  TORCH_CHECK_VALUE(exponent <= most, "linear_solve: unrolled in ", dtype_name(b_.scalar_type()),
                    ", A may change the size of a vector by a factor of 2^", most, ", got 2^", exponent,
                    "; scale A and b, or take ", in_language("backward=\"implicit\"", "Backward::kImplicit"));
}

TensorSpace::Scalar TensorSpace::update_iterate_and_residual(const Scalar& alpha, const Vector& p, const Vector& q,
                                                             Vector& x, Vector& r) {
  const bool projects = system_.a.needs_projection();
  if (in_loops_ && !projects) return batch_loops::update_iterate_and_residual(alpha, p, q, x, r, active_);
  x = keep_frozen(at::addcmul(x, alpha, p), x);
  const auto left = at::addcmul(r, alpha, q, -1);
  r = keep_frozen(projects ? system_.a.project(left) : left, r);
  return dot(r, r);
}

TensorSpace::Vector TensorSpace::product(const Vector& v) {
  interruption::Watch::local().look();
  for (size_t i = 0; i < states_.size(); ++i) states_[i].applications += is_active(i) && (ended_.empty() || !ended_[i]);
  return laid_out(system_.a.apply(in_loops_ ? v.detach() : v));  // a handle of its own, which a product may keep
}

TensorSpace::Vector TensorSpace::product_setting_scale(const Vector& v) {
  auto made = product(v);
  define_scale(made, v, system_.scale_of_a);
  return made;
}

void TensorSpace::apply(const Vector& v, Vector& out) {
  const auto made = product_setting_scale(v);
  if (in_loops_) return batch_loops::scale(system_.scale_of_a, made, out);
  out = made * system_.scale_of_a;
}

std::array<TensorSpace::Scalar, 2> TensorSpace::apply_along(const Vector& v, const Vector& w, Vector& out) {
  if (in_loops_) {
    const auto made = product_setting_scale(v);  // first: it sets the scale
    return batch_loops::scale_with_dots(system_.scale_of_a, made, w, out);
  }
  apply(v, out);
  return {dot(w, out), dot(out, out)};
}

TensorSpace::Scalar TensorSpace::residual(const Vector& x, Vector& r) {
  ended_.clear();
  const auto ax = product(solution(x));
  r = keep_frozen(system_.a.project((started() ? given_b_ : b_) - ax), r);
  return dot(r, r);
}

TensorSpace::Scalar TensorSpace::precondition(const Vector& v, Vector& out) {
  auto z = system_.inverse ? laid_out(system_.inverse(v)) : v / diagonal();
  if (system_.inverse) {
    define_scale(z, v, system_.scale_of_inverse);
    z = z * system_.scale_of_inverse;
    if (system_.a.needs_projection()) z = system_.a.project_solution(z);
  }
  out = keep_frozen(z, out);
  return dot(v, z);
}

void TensorSpace::apply_cycle(const Vector& v, Vector& out) {
  const auto z = laid_out(system_.inverse(v));
  out = keep_frozen(system_.a.needs_projection() ? system_.a.project_solution(z) : z, out);
}

TensorSpace::Vector TensorSpace::swept(const Vector& x, const Vector& change, const Vector& before,
                                       const Scalar* omega) const {
  if (!omega) return x + change;
  const auto step = x + change - before;
  if (is_number_of_host(*omega)) return at::add(before, step, omega->item());
  return at::addcmul(before, omega->to(b_.options()), step);
}

TensorSpace::Scalar TensorSpace::measured_sweep(const Vector& c, const Vector& x, Vector& y, const Scalar* omega) {
  const auto change = jacobi_change(c, x);
  y = swept(x, change, /*before=*/y, omega);
  const auto r = diagonal() * change;
  return dot(r, r);
}

TensorSpace::Vector TensorSpace::solution(const Vector& x) const {
  const auto from_zero = system_.scale_of_a.defined() ? x * system_.scale_of_a : x;
  return started() ? start_ + from_zero : from_zero;
}

namespace {

/// The signs of a pattern, the same for every sample.
at::Tensor signs_like(const at::Tensor& v, int64_t first, int64_t pattern) {
  const int64_t n = v.numel() / std::max<int64_t>(v.size(0), 1);
  std::vector<double> signs(n);
  for (int64_t i = 0; i < n; ++i) signs[i] = is_negated(first + i, pattern) ? -1.0 : 1.0;
  auto shape = v.sizes().vec();
  shape[0] = 1;
  return at::tensor(signs, at::kDouble).to(v.options()).view(shape);
}

}  // namespace

TensorSpace::Scalar TensorSpace::componentwise_scale2(const Vector& x, int64_t attempt) const {
  const auto u = solution(x).detach();
  // as is_negated_in() of sample_numbers.h
  const auto signed_u = attempt == 0 ? at::where(unstructured_like(u).lt(0), -u, u) : u * signs_like(u, 0, attempt);
  const auto terms = laid_out(system_.a.apply(signed_u));
  return dot(terms, terms);
}

TensorSpace::Scalar TensorSpace::skeel_estimate2(const Vector& x) const {
  const auto u = solution(x).detach();
  const int64_t n = u.numel() / std::max<int64_t>(u.size(0), 1);
  at::Tensor scale2, largest;  // of |A| |u|; of all solves
  for (int64_t p = 0; p < kSignPatterns; ++p) add_to(scale2, system_.a.apply(u * signs_like(u, 0, p)).square());
  const auto scale = (scale2 / static_cast<double>(kSignPatterns)).sqrt();
  for (int64_t p = 0; p < kSignPatterns; ++p) {
    const auto moved =
        in_units_of_x(laid_out(system_.a.solve_directly(scale * signs_like(u, n, p), /*transposed=*/false)));
    const auto square = dot(moved, moved);
    largest = largest.defined() ? at::maximum(largest, square) : square;  // NaN stays
  }
  return largest;
}

void TensorSpace::solve_directly(const Vector& r, Vector& d) {
  const auto solution = system_.a.solve_directly(r, /*transposed=*/false);
  const auto finite = per_sample(solution.isfinite().flatten(1).all(1), solution);
  note_broken(finite.logical_not());
  d = laid_out(at::where(finite, solution, at::zeros_like(solution)));
}

bool TensorSpace::all_ended(const Scalar& ended) {
  if (!ended.is_cpu()) return false;  // it would have to be waited for
  std::vector<bool> rows;
  for (const double value : values_of(ended)) rows.push_back(value != 0.0);
  return all_ended(rows);
}

bool TensorSpace::all_ended(const std::vector<bool>& ended) {
  // Later cycles seldom end: the basis goes on with zeros.
  if (std::any_of(states_.begin(), states_.end(), [](const auto& s) { return s.iterations > 0; })) return false;
  ended_ = ended;
  bool all = true;
  for (size_t i = 0; i < ended.size(); ++i) all = all && (ended[i] || !is_active(i));
  return all;
}

at::Tensor TensorSpace::enough2() const {
  std::vector<double> squares;
  for (const auto& s : states_) squares.push_back(s.enough2);
  return at::tensor(squares, at::kDouble).to(b2_).view_as(b2_);
}

std::vector<double> TensorSpace::values_of(const Scalar& value) const {
  return to_host<double>(value, static_cast<int64_t>(states_.size()));
}

std::vector<bool> TensorSpace::broken() const {
  std::vector<bool> rows(states_.size());
  if (!broken_.defined()) return rows;
  const auto host = to_host<double>(broken_, static_cast<int64_t>(states_.size()));
  for (size_t i = 0; i < rows.size(); ++i) rows[i] = host[i] != 0.0;
  return rows;
}

const std::vector<double>& TensorSpace::operator_norm() {
  if (!norms_.empty()) return norms_;
  const auto batch = static_cast<int64_t>(states_.size());
  norms_ = to_host<double>(system_.a.norm(), batch);
  const bool known = std::any_of(norms_.begin(), norms_.end(), [](double norm) { return norm > 0.0; });
  if (!known) norms_ = to_host<double>(estimated_norm(system_.a, b_), batch);
  if (!system_.scale_of_a.defined()) return norms_;
  const auto scales = to_host<double>(system_.scale_of_a, batch);
  for (int64_t i = 0; i < batch; ++i) norms_[i] *= scales[i];
  return norms_;
}

TensorSpace::Vector TensorSpace::select(const std::vector<bool>& wanted, const Vector& kept, const Vector& x) const {
  return at::where(mask_of(wanted), x, kept);
}

void TensorSpace::note_broken(const at::Tensor& rows) {
  const auto now = active_mask_.defined() ? rows.logical_and(active_mask_) : rows;
  broken_ = broken_.defined() ? broken_.logical_or(now) : now;
}

void TensorSpace::reset() {
  broken_ = at::Tensor();
  active_mask_ = at::Tensor();
  active_.clear();
}

void TensorSpace::set_active(const std::vector<bool>& active) {
  if (active == active_) return;
  active_ = active;
  const bool all = std::all_of(active.begin(), active.end(), [](bool a) { return a; });
  active_mask_ = all ? at::Tensor() : mask_of(active);
}

at::Tensor TensorSpace::mask_of(const std::vector<bool>& rows) const {
  std::vector<int64_t> shape(b_.dim(), 1);
  shape[0] = static_cast<int64_t>(rows.size());
  auto mask = at::empty(shape, at::kBool);
  std::copy(rows.begin(), rows.end(), mask.mutable_data_ptr<bool>());
  return mask.to(b_.device());
}

}  // namespace prdp
