#include "prdp/kernels/multigrid.h"

#include "prdp/kernels/saddle_point.h"
#include "prdp/kernels/stencil.h"

namespace prdp::kernels {

template <class T>
std::unique_ptr<Multigrid<T>> Multigrid<T>::make(const Kernel<T>& a, const Kernel<T>* transpose, int64_t smoothing) {
  const auto given = a.grid_operator();
  if (!given) return nullptr;
  struct Kept {  // null stands for a hierarchy that could not be made: that is kept, too
    std::shared_ptr<const Hierarchy<T>> hierarchy;
    int64_t bytes() const { return hierarchy ? hierarchy->bytes() : 0; }
  };
  const int64_t nullity = a.needs_projection() ? a.null_space()->count_in_one_field() : 0;
  const auto key = FactorKeyMaker().add(given->key).add(nullity).key();
  const auto kept = factor_cache::find_or_make<Kept>(key, [&] {
    auto finest = given->make();
    return std::make_shared<Kept>(Kept{finest ? Hierarchy<T>::make(std::move(*finest), nullity) : nullptr});
  });
  if (!kept->hierarchy) return nullptr;
  return std::unique_ptr<Multigrid>(new Multigrid(kept->hierarchy, a, transpose, given->transposed, smoothing));
}

template <class T>
Multigrid<T>::Multigrid(std::shared_ptr<const Hierarchy<T>> hierarchy, const Kernel<T>& a, const Kernel<T>* transpose,
                        bool given_transposed, int64_t smoothing)
    : hierarchy_(std::move(hierarchy)), given_transposed_(given_transposed) {
  levels_.reserve(hierarchy_->levels().size());
  add_level(0, a, transpose, smoothing);
  // In the layout of a Stencil, planes are channels; in that of a Laplacian, which has one, they are planes of the
  // grid.
  const bool channels = dynamic_cast<const Stencil<T>*>(&a) != nullptr;
  const int64_t fields = channels ? a.layout().planes : 1;
  levels_[0].grid = PaddedGrid::of(a.layout(), hierarchy_->levels()[0].grid, channels);
  for (size_t l = 1; l < hierarchy_->levels().size(); ++l) {
    auto own = std::make_unique<Stencil<T>>(hierarchy_->packed(l, given_transposed), fields, T(1));
    std::unique_ptr<Kernel<T>> own_transpose;
    if (transpose) own_transpose = std::make_unique<Stencil<T>>(hierarchy_->packed(l, !given_transposed), fields, T(1));
    add_level(l, *own, own_transpose.get(), smoothing);
    levels_[l].own = std::move(own);
    levels_[l].own_transpose = std::move(own_transpose);
    levels_[l].grid = PaddedGrid::of(levels_[l].a->layout(), hierarchy_->levels()[l].grid, true);
  }
  for (size_t l = 0; l < levels_.size(); ++l) {
    auto& level = levels_[l];
    const auto& transfers = hierarchy_->levels()[l].transfers;
    int64_t length = level.a->length();
    for (size_t t = 0; t + 1 < transfers.size(); ++t) {
      const auto& grid = transfers[t].coarse();
      const auto layout = Layout<T>::of_fields(fields, grid.shape[0] * grid.shape[1], grid.shape[2]);
      level.part_way.push_back(PaddedGrid::of(layout, grid, true));
      length = std::max(length, layout.length());
    }
    level.memory.prepare(kPartWay + static_cast<int64_t>(level.part_way.size()), length, level.a->layout().halo);
  }
}

template <class T>
void Multigrid<T>::add_level(size_t l, const Kernel<T>& a, const Kernel<T>* transpose, int64_t smoothing) {
  levels_.emplace_back();
  levels_.back().a = &a;
  levels_.back().transpose = transpose;
  SmoothingSteps steps(hierarchy_->levels()[l].radius);
  for (int64_t s = 0; s < smoothing; ++s) {
    const auto [p, q] = steps.next();
    levels_.back().p.push_back(static_cast<T>(p));
    levels_.back().q.push_back(static_cast<T>(q));
  }
}

template <class T>
T Multigrid<T>::apply(const T* r, T* z) {
  const int64_t length = levels_[0].a->length();
  vectors_.copy(cycle(0, r, false), z, length);
  return vectors_.dot(r, z, length);
}

template <class T>
void Multigrid<T>::apply_transpose(const T* r, T* z) {
  vectors_.copy(cycle(0, r, true), z, levels_[0].a->length());
}

template <class T>
const T* Multigrid<T>::cycle(size_t l, const T* b, bool transposed) {
  auto& level = levels_[l];
  if (hierarchy_->levels()[l].transfers.empty()) return solve_coarsest(b, transposed);
  const auto& a = kernel(level, transposed);
  const int64_t length = a.length();
  T *x = level.memory.vector(kX), *y = level.memory.vector(kY), *r = level.memory.vector(kR);

  a.divide_by_diagonal(b, x);
  vectors_.scale(level.q[0], x, x, length);
  vectors_.fill_zero(y, length);
  for (size_t s = 1; s < level.p.size(); ++s, std::swap(x, y)) a.smooth(b, x, y, level.p[s], level.q[s]);

  a.residual(b, x, r);
  const T* const coarse_b = restrict_residual(l, transposed);
  add_correction(l, cycle(l + 1, coarse_b, transposed), x, transposed);

  for (size_t s = 0; s < level.p.size(); ++s, std::swap(x, y)) a.smooth(b, x, y, level.p[s], level.q[s]);
  return x;
}

template <class T>
const T* Multigrid<T>::restrict_residual(size_t l, bool transposed) {
  auto &level = levels_[l], &next = levels_[l + 1];
  const auto& transfers = hierarchy_->levels()[l].transfers;
  const size_t last = transfers.size() - 1;
  for (size_t t = 0; t < last; ++t)
    transfers[t].restrict(level.grid_before(t), level.vector_before(t), level.grid_before(t + 1),
                          level.vector_before(t + 1), is_of_transpose(transposed));
  T* const coarse_b = next.memory.vector(kB);
  transfers[last].restrict(level.grid_before(last), level.vector_before(last), next.grid, coarse_b,
                           is_of_transpose(transposed));
  return coarse_b;
}

template <class T>
void Multigrid<T>::add_correction(size_t l, const T* correction, T* x, bool transposed) {
  auto& level = levels_[l];
  const auto& transfers = hierarchy_->levels()[l].transfers;
  const PaddedGrid* from = &levels_[l + 1].grid;
  for (size_t t = transfers.size() - 1; t > 0; --t) {
    const PaddedGrid& to = level.grid_before(t);
    T* const finer = level.vector_before(t);
    vectors_.fill_zero(finer, to.fields * to.field);
    transfers[t].add_interpolated(*from, correction, to, finer, is_of_transpose(transposed));
    correction = finer;
    from = &to;
  }
  transfers[0].add_interpolated(*from, correction, level.grid, x, is_of_transpose(transposed));
}

template <class T>
const T* Multigrid<T>::solve_coarsest(const T* b, bool transposed) {
  auto& level = levels_.back();
  const auto& layout = level.a->layout();
  const auto& inverse = hierarchy_->coarsest_inverse();
  const auto& points = hierarchy_->levels().back().grid.shape;
  const int64_t n = points[0] * points[1] * points[2], fields = layout.unknowns() / n;
  contiguous_.resize(layout.unknowns());
  solved_.resize(layout.unknowns());
  layout.store(b, T(1), contiguous_.data());
  const bool by_columns = is_of_transpose(transposed);
  for (int64_t f = 0; f < fields; ++f)
    for (int64_t i = 0; i < n; ++i) {
      T sum = 0;
      for (int64_t j = 0; j < n; ++j) sum += inverse[by_columns ? j * n + i : i * n + j] * contiguous_[f * n + j];
      solved_[f * n + i] = sum;
    }
  T* const x = level.memory.vector(kX);
  layout.load(solved_.data(), T(1), x);
  return x;
}

template <class T>
std::unique_ptr<Preconditioner<T>> Kernel<T>::multigrid(const Kernel<T>* transpose, int64_t smoothing) const {
  return Multigrid<T>::make(*this, transpose, smoothing);
}
template <class T>
std::unique_ptr<Preconditioner<T>> NavierStokes<T>::multigrid(const Kernel<T>* transpose, int64_t smoothing) const {
  return std::make_unique<SaddlePointPreconditioner<T>>(*this, dynamic_cast<const NavierStokes<T>*>(transpose),
                                                        smoothing);
}

#define PRDP_INSTANTIATE(T)                                                                          \
  template std::unique_ptr<Preconditioner<T>> Kernel<T>::multigrid(const Kernel<T>*, int64_t) const; \
  template std::unique_ptr<Preconditioner<T>> NavierStokes<T>::multigrid(const Kernel<T>*, int64_t) const;
PRDP_INSTANTIATE(float)
PRDP_INSTANTIATE(double)
#undef PRDP_INSTANTIATE
template class Multigrid<float>;
template class Multigrid<double>;

}  // namespace prdp::kernels
