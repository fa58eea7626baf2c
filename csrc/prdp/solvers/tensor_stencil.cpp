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

/// The colours of an axis: points of one colour are at least three apart, round its end too.
int64_t colours(int64_t n) { return n <= 5 ? n : 3 + n % 3; }
int64_t colour(int64_t i, int64_t n) { return n <= 5 ? i : i < n - n % 3 ? i % 3 : 3 + i - (n - n % 3); }

at::Tensor points_of_colour(int64_t n, int64_t which, const at::TensorOptions& options) {
  std::vector<double> mask(n);
  for (int64_t i = 0; i < n; ++i) mask[i] = colour(i, n) == which;
  return at::tensor(mask, at::kDouble).to(options);
}

/// Drops the neighbours that no point is coupled to. With `find_periodic`, an axis is periodic if its ends are coupled.
void drop_zeros(TensorStencil& a, bool find_periodic) {
  std::vector<at::Tensor> couples;  // points at all; and through the end of each axis
  for (const auto& [offset, coefficient] : a.entries) {
    couples.push_back(coefficient.ne(0).any());
    for (int64_t d = 0; d < a.dim(); ++d)
      couples.push_back(coefficient.select(d - a.dim(), offset[d] > 0 ? -1 : 0).ne(0).any());
  }
  const auto host = at::stack(couples).to(at::kCPU);
  const bool* next = host.const_data_ptr<bool>();
  std::vector<bool> ends(a.dim());
  std::vector<TensorStencil::Entry> kept;
  for (const auto& entry : a.entries) {
    const bool is_centre = kept.empty();
    if (*next++ || is_centre) kept.push_back(entry);
    for (int64_t d = 0; d < a.dim(); ++d, ++next) ends[d] = ends[d] || (entry.offset[d] != 0 && *next);
  }
  a.entries = std::move(kept);
  if (find_periodic) a.periodic = ends;
}

}  // namespace

at::Tensor neighbours(const at::Tensor& t, const TensorStencil& like, const std::vector<int64_t>& offset) {
  auto shifted = t;
  for (int64_t d = 0; d < like.dim(); ++d) shifted = along_axis(shifted, d - like.dim(), offset[d], like.periodic[d]);
  return shifted;
}

at::Tensor TensorStencil::apply(const at::Tensor& v) const {
  at::Tensor sum;
  for (const auto& [offset, coefficient] : entries) {
    const auto product = coefficient.unsqueeze(1) * neighbours(v, *this, offset);
    sum = sum.defined() ? sum + product : product;
  }
  return sum;
}

TensorStencil TensorStencil::transposed() const {
  TensorStencil other{shape, periodic, {}};
  for (const auto& [offset, coefficient] : entries) {
    auto back = offset;
    // In a ring of two, the one neighbour lies on both sides.
    for (size_t d = 0; d < back.size(); ++d) back[d] = shape[d] == 2 && periodic[d] ? offset[d] : -offset[d];
    other.entries.push_back({back, neighbours(coefficient, *this, back)});
  }
  return other;
}

TensorStencil probe(const std::function<at::Tensor(const at::Tensor&)>& product, int64_t batch,
                    const std::vector<int64_t>& shape, const at::TensorOptions& options,
                    const std::vector<bool>* periodic) {
  const auto dim = static_cast<int64_t>(shape.size());
  TensorStencil found{shape, std::vector<bool>(dim, true), {}};
  for (const auto& offset : offsets_of(shape)) {
    auto sizes = shape;
    sizes.insert(sizes.begin(), batch);
    found.entries.push_back({offset, at::zeros(sizes, options)});
  }
  int64_t all = 1;
  for (const int64_t n : shape) all *= colours(n);
  for (int64_t number = 0; number < all; ++number) {
    auto mask = at::ones({}, options);
    int64_t rest = number;
    for (int64_t d = 0; d < dim; rest /= colours(shape[d]), ++d)
      mask = mask.unsqueeze(-1) * points_of_colour(shape[d], rest % colours(shape[d]), options);
    auto sizes = shape;
    sizes.insert(sizes.begin(), {batch, 1});
    const auto made = product(mask.expand(sizes)).squeeze(1).nan_to_num(0.0, 0.0, 0.0);  // of a sample that is refused
    // Of what a point's product holds, the part of the neighbour that has this colour.
    for (auto& [offset, coefficient] : found.entries)
      coefficient = coefficient + made * neighbours(mask, found, offset);
  }
  if (periodic) found.periodic = *periodic;
  drop_zeros(found, /*find_periodic=*/!periodic);
  for (int64_t d = 0; d < dim; ++d)
    if (shape[d] == 2) found.periodic[d] = true;  // two points are a ring
  return found;
}

}  // namespace prdp
