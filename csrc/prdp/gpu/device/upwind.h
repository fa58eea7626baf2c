#pragma once
#include "prdp/gpu/device/views.h"

/// Flows on periodic grids, made of their winds in each product: two numbers are read where five coefficients would be.
namespace prdp::gpu {

/// An axis as an argument.
template <int axis>
struct Along {};

/// The next point along an axis, 0 along x and 1 along y; with cells = -1, the one before.
template <int axis, int cells, class G>
G next_along(G at) {
  if constexpr (axis == 0) at.x = moved<G::kX, cells, true>(at.x);
  else at.y = moved<G::kY, cells, true>(at.y);
  return at;
}

/// C = α I + β (Γ - ν L), with upwind differences Γ, or its transpose. Numbers: α, β, ν, and 1/h along y and x.
/// Tensors: the winds (channel, ny, nx), and where it is there, a number that ν is multiplied by.
template <class T, class G, bool kTransposed>
class Upwind {
 public:
  Upwind(const OperatorArguments& a, int64_t sample)
      : winds_(static_cast<const T*>(a.tensors[0]) + sample * a.sample_strides[0]),
        alpha_(static_cast<T>(a.numbers[0])),
        beta_(static_cast<T>(a.numbers[1])),
        inverse_h_{static_cast<T>(a.numbers[4]), static_cast<T>(a.numbers[3])} {
    const T* const by = static_cast<const T*>(a.tensors[1]);
    constexpr double not_allowed = std::numeric_limits<double>::quiet_NaN();
    const double nu = !by ? a.numbers[2] : *by >= T(0) ? a.numbers[2] * static_cast<double>(*by) : not_allowed;
    for (int axis = 0; axis < 2; ++axis)
      diffusion_[axis] = static_cast<T>(a.numbers[1] * nu * a.numbers[4 - axis] * a.numbers[4 - axis]);
  }

  T inverse_h(int axis) const { return inverse_h_[axis]; }
  T wind(int channel, const G& at) const { return winds_[channel * G::kPoints + at.point()]; }

  /// f(c_ij, j) at a point of the channel whose first unknown is `first`. The winds at the lower and the upper face of
  /// a cell: lower(axis, point), upper(axis, point), with an Along.
  template <class Lower, class Upper, class F>
  void for_each_entry(const G& at, int first, const Lower& lower, const Upper& upper, const F& f) const {
    T centre = alpha_;
    centre += couple<0>(at, first, lower, upper, f);
    if constexpr (G::kY > 1) centre += couple<1>(at, first, lower, upper, f);
    f(centre, first + at.point());
  }

 private:
  static T positive(T w) { return T(0.5) * (w + std::abs(w)); }  // NaN stays NaN
  static T negative(T w) { return T(0.5) * (w - std::abs(w)); }

  /// Returns the part of the diagonal.
  template <int axis, class Lower, class Upper, class F>
  T couple(const G& at, int first, const Lower& lower, const Upper& upper, const F& f) const {
    constexpr Along<axis> along;
    const G before = next_along<axis, -1>(at), after = next_along<axis, 1>(at);
    const T speed = beta_ * inverse_h_[axis], spread = diffusion_[axis];
    const T below = positive(lower(along, at)), above = negative(upper(along, at));
    // What couples a point to its neighbour belongs to the neighbour in the transpose.
    const T to_before = kTransposed ? negative(upper(along, before)) : -below;
    const T to_after = kTransposed ? -positive(lower(along, after)) : above;
    f(speed * to_before - spread, first + before.point());
    f(speed * to_after - spread, first + after.point());
    return speed * (below - above) + 2 * spread;
  }

  const T* winds_;
  T alpha_, beta_;
  T inverse_h_[2], diffusion_[2];
};

/// The same block for every channel; its winds are means at the faces.
template <class T, class G, int kChannels, bool kTransposed>
class Burgers : public Rows<Burgers<T, G, kChannels, kTransposed>, T> {
 public:
  static constexpr int kUnknowns = kChannels * G::kPoints;

  Burgers(const OperatorArguments& a, int64_t sample) : block_(a, sample) {}

  template <class F>
  void for_each_entry(int i, const F& f) const {
    const int point = i % G::kPoints;
    const auto lower = [&]<int axis>(Along<axis>, const G& at) {
      return T(0.5) * (block_.wind(axis, next_along<axis, -1>(at)) + block_.wind(axis, at));
    };
    const auto upper = [&]<int axis>(Along<axis>, const G& at) {
      return T(0.5) * (block_.wind(axis, at) + block_.wind(axis, next_along<axis, 1>(at)));
    };
    block_.for_each_entry(G(point), i - point, lower, upper, f);
  }

 private:
  using Block = Upwind<T, G, kTransposed>;
  Block block_;
};

/// [[C₁, 0, G₁], [0, C₂, G₂], [D₁, D₂, 0]] on a staggered grid: u₁ on the left faces, u₂ on the bottom faces, p in the
/// centres of the cells.
template <class T, class G, bool kTransposed>
class NavierStokes : public Rows<NavierStokes<T, G, kTransposed>, T> {
 public:
  static constexpr int kUnknowns = 3 * G::kPoints;

  NavierStokes(const OperatorArguments& a, int64_t sample) : block_(a, sample) {}

  template <class F>
  void for_each_entry(int i, const F& f) const {
    const int point = i % G::kPoints, channel = i / G::kPoints;
    const G at(point);
    if (channel == 2) {
      divergence<0>(at, f);
      divergence<1>(at, f);
      return;
    }
    // The wind at the points of u₁ or u₂: its own component, and the mean of four neighbours of the other one.
    const auto wind = [&]<int axis>(Along<axis>, const G& here) {
      if (axis == channel) return block_.wind(axis, here);
      if constexpr (axis == 0) return mean<0, 1, 1, -1>(here);
      else return mean<1, 1, 0, -1>(here);
    };
    block_.for_each_entry(at, channel * G::kPoints, wind, wind, f);
    if (channel == 0) gradient<0>(at, f);
    else gradient<1>(at, f);
  }

 private:
  using Block = Upwind<T, G, kTransposed>;

  /// Of the component `of`, over two points along one axis and two along the other.
  template <int of, int cells, int other, int other_cells>
  T mean(const G& at) const {
    const G beside = next_along<of, cells>(at), across = next_along<other, other_cells>(at);
    const G both = next_along<other, other_cells>(beside);
    return T(0.25) * (block_.wind(of, at) + block_.wind(of, beside) + block_.wind(of, across) + block_.wind(of, both));
  }
  T difference(int axis) const { return kTransposed ? -block_.inverse_h(axis) : block_.inverse_h(axis); }
  template <int axis, class F>
  void gradient(const G& at, const F& f) const {
    f(difference(axis), 2 * G::kPoints + at.point());
    f(-difference(axis), 2 * G::kPoints + next_along<axis, -1>(at).point());
  }
  template <int axis, class F>
  void divergence(const G& at, const F& f) const {
    f(difference(axis), axis * G::kPoints + next_along<axis, 1>(at).point());
    f(-difference(axis), axis * G::kPoints + at.point());
  }

  Block block_;
};

}  // namespace prdp::gpu
