#include "prdp/kernels/stencil_sparsity.h"

#include <algorithm>
#include <cstdlib>

namespace prdp::kernels {

namespace {

/// The shortest offset that leads to the same point of a periodic axis.
int64_t shortest(int64_t offset, int64_t n) {
  const int64_t forward = (offset % n + n) % n;
  return 2 * forward > n ? forward - n : forward;
}

int64_t distance(const Offset& o) { return std::abs(o.along[0]) + std::abs(o.along[1]) + std::abs(o.along[2]); }

}  // namespace

std::vector<Offset> StencilSparsity::nearest_neighbours(int64_t dim) {
  std::vector<Offset> found{{{0, 0, 0}}};
  for (int64_t axis = 2; axis > 2 - dim; --axis)
    for (const int64_t step : {-1, 1}) {
      found.push_back({{0, 0, 0}});
      found.back().along[axis] = step;
    }
  return found;
}

StencilSparsity::StencilSparsity(const StencilGrid& on, const std::vector<Offset>& given)
    : grid(on), nearest(true), offsets(nearest_neighbours(on.dim)) {
  std::vector<Offset> wanted = given;
  std::vector<bool> leads_nowhere(given.size());
  for (size_t k = 0; k < wanted.size(); ++k) {
    for (int d = 0; d < 3; ++d) {
      int64_t& offset = wanted[k].along[d];
      if (grid.periodic[d]) offset = shortest(offset, grid.shape[d]);
      else if (std::abs(offset) >= grid.shape[d]) leads_nowhere[k] = true;
    }
    nearest = nearest && (leads_nowhere[k] || distance(wanted[k]) <= 1);
  }
  if (!nearest) offsets = {Offset{{0, 0, 0}}};
  for (size_t k = 0; k < wanted.size(); ++k) {
    if (leads_nowhere[k]) {
      places.push_back(-1);
      continue;
    }
    const auto found = std::find(offsets.begin(), offsets.end(), wanted[k]);
    places.push_back(found - offsets.begin());
    if (found == offsets.end()) offsets.push_back(wanted[k]);
  }
  if (nearest || !grid.periodic[2]) return;
  const int64_t nx = grid.shape[2];
  for (size_t k = 0; k < offsets.size(); ++k)
    for (int64_t i = 0; i < nx; ++i) {
      const int64_t x = offsets[k].along[2], j = neighbour(i, x, nx, true);
      if (j != i + x) wraps.push_back({static_cast<int64_t>(k), i, j - x});
    }
}

}  // namespace prdp::kernels
