#include "prdp/solvers/tensor_stencil.h"

#include <algorithm>

namespace prdp {

namespace {

at::Tensor along_axis(const at::Tensor& t, int64_t axis, int64_t offset, bool periodic) {
  if (offset == 0) return t;
  if (periodic) return t.roll(-offset, axis);
  const int64_t n = t.size(axis);
  const auto zeros = at::zeros_like(t.narrow(axis, 0, 1));
  if (offset > 0) return at::cat({t.narrow(axis, 1, n - 1), zeros}, axis);
  return at::cat({zeros, t.narrow(axis, 0, n - 1)}, axis);
}

/// Offsets that lead to different points: an axis of one point has no neighbour, a ring of two has one.
std::vector<std::vector<int64_t>> offsets_of(const std::vector<int64_t>& shape) {
  std::vector<std::vector<int64_t>> all{{}};
  for (const int64_t n : shape) {
    std::vector<std::vector<int64_t>> longer;
    for (const auto& offset : all)
      for (const int64_t o : {0, 1, -1}) {
        if (o == 0 || n > 2 || (n == 2 && o == 1)) {
          longer.push_back(offset);
          longer.back().push_back(o);
        }
      }
    all = std::move(longer);
  }
  return all;
}

/// t (…, *shape) with one more point before and after each axis along which the stencil reaches.
at::Tensor padded(at::Tensor t, const TensorStencil& like) {
  for (int64_t d = 0; d < like.dim(); ++d) {
    const auto reaches = [d](const TensorStencil::Entry& entry) { return entry.offset[d] != 0; };
    if (std::none_of(like.entries.begin(), like.entries.end(), reaches)) continue;
    const int64_t axis = d - like.dim(), n = like.shape[d];
    if (like.periodic[d]) {
      t = at::cat({t.narrow(axis, n - 1, 1), t, t.narrow(axis, 0, 1)}, axis);
    } else {
      std::vector<int64_t> ends(2 * (like.dim() - d));
      ends[ends.size() - 2] = ends.back() = 1;
      t = at::constant_pad_nd(t, ends);
    }
  }
  return t;
}

/// neighbours(t, like, offset) of padded(t), as a view.
at::Tensor shifted(at::Tensor t, const TensorStencil& like, const std::vector<int64_t>& offset) {
  for (int64_t d = 0; d < like.dim(); ++d) {
    const int64_t axis = d - like.dim(), n = like.shape[d];
    if (t.size(axis) > n) t = t.narrow(axis, 1 + offset[d], n);
  }
  return t;
}

/// The colours of an axis: points of one colour are at least three apart, round its end too. Every third point has the
/// same one, but for the last n % 3, which have one each.
int64_t colours(int64_t n) { return n <= 5 ? n : 3 + n % 3; }
at::Tensor colours_of_points(int64_t n, const at::TensorOptions& options) {
  const auto places = at::arange(n, options.dtype(at::kLong));
  if (n <= 5) return places;
  const int64_t rest = n - n % 3;
  return at::where(places.lt(rest), places.remainder(3), places - (rest - 3));
}

/// The number of the colour of each point, (*shape).
at::Tensor colours_of_grid(const std::vector<int64_t>& shape, const at::TensorOptions& options) {
  auto numbers = at::zeros({}, options.dtype(at::kLong));
  for (const int64_t n : shape) numbers = numbers.unsqueeze(-1) * colours(n) + colours_of_points(n, options);
  return numbers;
}

/// Drops the neighbours that no point is coupled to. An axis is periodic if its ends are coupled.
void drop_zeros(TensorStencil& a) {
  std::vector<at::Tensor> couples;  // points at all; and through the end of each axis
  for (const auto& [offset, coefficient] : a.entries) {
    couples.push_back(coefficient.ne(0).any());
    for (int64_t d = 0; d < a.dim(); ++d)
      couples.push_back(coefficient.select(d - a.dim(), offset[d] > 0 ? -1 : 0).ne(0).any());
  }
  const auto host = at::stack(couples).to(at::kCPU);
  const bool* next = host.const_data_ptr<bool>();
  a.periodic.assign(a.dim(), false);
  std::vector<TensorStencil::Entry> kept;
  for (const auto& entry : a.entries) {
    const bool is_centre = kept.empty();
    if (*next++ || is_centre) kept.push_back(entry);
    for (int64_t d = 0; d < a.dim(); ++d, ++next) a.periodic[d] = a.periodic[d] || (entry.offset[d] != 0 && *next);
  }
  a.entries = std::move(kept);
}

}  // namespace

at::Tensor neighbours(const at::Tensor& t, const TensorStencil& like, const std::vector<int64_t>& offset) {
  auto shifted = t;
  for (int64_t d = 0; d < like.dim(); ++d) shifted = along_axis(shifted, d - like.dim(), offset[d], like.periodic[d]);
  return shifted;
}

at::Tensor TensorStencil::apply(const at::Tensor& v) const {
  const auto wide = padded(v, *this);
  at::Tensor sum;
  for (const auto& [offset, coefficient] : entries) {
    const auto factor = coefficient.unsqueeze(1), there = shifted(wide, *this, offset);
    sum = sum.defined() ? at::addcmul(sum, factor, there) : factor * there;
  }
  return sum;
}

at::Tensor TensorStencil::residual(const at::Tensor& b, const at::Tensor& v) const {
  const auto wide = padded(v, *this);
  auto left = b;
  for (const auto& [offset, coefficient] : entries)
    left = at::addcmul(left, coefficient.unsqueeze(1), shifted(wide, *this, offset), -1.0);
  return left;
}

TensorStencil TensorStencil::transposed() const {
  const auto wide = padded(coefficients(), *this);
  TensorStencil other{shape, periodic, {}};
  for (size_t e = 0; e < entries.size(); ++e) {
    auto back = entries[e].offset;
    // In a ring of two, the one neighbour lies on both sides.
    for (size_t d = 0; d < back.size(); ++d) back[d] = shape[d] == 2 && periodic[d] ? back[d] : -back[d];
    other.entries.push_back({back, shifted(wide.select(0, e), *this, back)});
  }
  return other;
}

at::Tensor TensorStencil::coefficients() const {
  std::vector<at::Tensor> all;
  for (const auto& entry : entries) all.push_back(entry.coefficient);
  return at::stack(all);
}

TensorStencil probe(const std::function<at::Tensor(const at::Tensor&)>& product, int64_t batch,
                    const std::vector<int64_t>& shape, const at::TensorOptions& options) {
  TensorStencil found{shape, std::vector<bool>(shape.size(), true), {}};
  auto sizes = shape;
  sizes.insert(sizes.begin(), batch);
  const auto colour = colours_of_grid(shape, options);
  std::vector<at::Tensor> colour_there;
  for (const auto& offset : offsets_of(shape)) {
    found.entries.push_back({offset, at::zeros(sizes, options)});
    colour_there.push_back(neighbours(colour, found, offset));
  }
  sizes.insert(sizes.begin() + 1, 1);
  int64_t all = 1;
  for (const int64_t n : shape) all *= colours(n);
  for (int64_t number = 0; number < all; ++number) {
    const auto made = product(colour.eq(number).to(options).expand(sizes)).squeeze(1);
    // Of what a point's product holds, the part of the neighbour that has this colour.
    for (size_t e = 0; e < found.entries.size(); ++e) {
      auto& coefficient = found.entries[e].coefficient;
      coefficient = at::where(colour_there[e].eq(number), made, coefficient);
    }
  }
  for (auto& entry : found.entries)
    entry.coefficient = entry.coefficient.nan_to_num(0.0, 0.0, 0.0);  // of a sample that is refused
  drop_zeros(found);
  for (size_t d = 0; d < shape.size(); ++d)
    if (shape[d] == 2) found.periodic[d] = true;  // two points are a ring
  return found;
}

}  // namespace prdp
