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
    const T* const by = a.tensors[1] ? static_cast<const T*>(a.tensors[1]) + sample * a.sample_strides[1] : nullptr;
    constexpr double not_allowed = std::numeric_limits<double>::quiet_NaN();
    nu_ = !by ? a.numbers[2] : *by >= T(0) ? a.numbers[2] * static_cast<double>(*by) : not_allowed;
    for (int axis = 0; axis < 2; ++axis)
      diffusion_[axis] = static_cast<T>(a.numbers[1] * nu_ * a.numbers[4 - axis] * a.numbers[4 - axis]);
  }

  T inverse_h(int axis) const { return inverse_h_[axis]; }
  double nu() const { return nu_; }
  T wind(int channel, const G& at) const { return winds_[channel * G::kPoints + at.point()]; }

  /// f(c_ij, j, dy, dx) at a point of the channel whose first unknown is `first`. The winds at the lower and the upper
  /// face of a cell: lower(axis, point), upper(axis, point), with an Along.
  template <class Lower, class Upper, class F>
  void for_each_entry(const G& at, int first, const Lower& lower, const Upper& upper, const F& f) const {
    T centre = alpha_;
    centre += couple<0>(at, first, lower, upper, f);
    if constexpr (G::kY > 1) centre += couple<1>(at, first, lower, upper, f);
    f(centre, first + at.point(), 0, 0);
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
    f(speed * to_before - spread, first + before.point(), axis == 1 ? -1 : 0, axis == 0 ? -1 : 0);
    f(speed * to_after - spread, first + after.point(), axis == 1 ? 1 : 0, axis == 0 ? 1 : 0);
    return speed * (below - above) + 2 * spread;
  }

  const T* winds_;
  double nu_;
  T alpha_, beta_;
  T inverse_h_[2], diffusion_[2];
};

/// The same block for every channel; its winds are means at the faces.
template <class T, class G, int kChannels, bool kTransposed>
class Burgers : public OperatorRows<Burgers<T, G, kChannels, kTransposed>, T> {
 public:
  static constexpr int kUnknowns = kChannels * G::kPoints;

  Burgers(const OperatorArguments& a, int64_t sample) : block_(a, sample) {}

  using Cycled = Burgers;
  using Points = G;
  static constexpr bool periodic(int axis) { return axis == 2 || (axis == 1 && G::kY > 1); }
  template <class F>
  void for_each_entry(int i, const F& f) const {
    const int point = i % G::kPoints;
    for_each_coefficient(point, i - point, [&](T a, int j, int, int) { f(a, j); });
  }
  template <class F>
  void for_each_offset(int point, const F& f) const {
    for_each_coefficient(point, 0, [&](T a, int, int dy, int dx) { f(a, 0, dy, dx); });
  }

 private:
  template <class F>
  void for_each_coefficient(int point, int first, const F& f) const {
    const auto lower = [&]<int axis>(Along<axis>, const G& at) {
      return T(0.5) * (block_.wind(axis, next_along<axis, -1>(at)) + block_.wind(axis, at));
    };
    const auto upper = [&]<int axis>(Along<axis>, const G& at) {
      return T(0.5) * (block_.wind(axis, at) + block_.wind(axis, next_along<axis, 1>(at)));
    };
    block_.for_each_entry(G(point), first, lower, upper, f);
  }

  using Block = Upwind<T, G, kTransposed>;
  Block block_;
};

/// -L on a periodic grid, times the square of the smaller spacing. Numbers: as those of Upwind.
template <class T, class G>
class PressureLaplacian {
 public:
  static constexpr int kUnknowns = G::kPoints;
  static constexpr bool kIsScaled = true;
  using Cycled = PressureLaplacian;
  using Points = G;
  static constexpr bool periodic(int) { return true; }

  PressureLaplacian(const OperatorArguments& a, int64_t) {
    const double y = G::kY > 1 ? a.numbers[3] * a.numbers[3] : 0.0, x = G::kX > 1 ? a.numbers[4] * a.numbers[4] : 0.0;
    largest_ = std::max(x, y);
    y_ = static_cast<T>(-y / largest_);
    x_ = static_cast<T>(-x / largest_);
    centre_ = static_cast<T>(2 * (x + y) / largest_);
  }

  T factor() const { return 1; }
  /// What -L was divided by.
  double largest() const { return largest_; }
  double norm_of_row(int) const { return 2 * static_cast<double>(centre_); }
  template <class F>
  void for_each_offset(int, const F& f) const {
    for_each_nearest(centre_, T(0), y_, x_, f);
  }
  template <class V>
  T product(const V& v, int i) const {
    const G at(i);
    const T along_x = v[next_along<0, -1>(at).point()] + v[next_along<0, 1>(at).point()];
    const T along_y = v[next_along<1, -1>(at).point()] + v[next_along<1, 1>(at).point()];
    return centre_ * v[i] + x_ * along_x + y_ * along_y;
  }

 private:
  double largest_;
  T centre_, y_, x_;
};

/// [[C₁, 0, G₁], [0, C₂, G₂], [D₁, D₂, 0]] on a staggered grid: u₁ on the left faces, u₂ on the bottom faces, p in the
/// centres of the cells.
template <class T, class G, bool kTransposed>
class NavierStokes : public OperatorRows<NavierStokes<T, G, kTransposed>, T> {
 public:
  static constexpr int kUnknowns = 3 * G::kPoints;

  using Cycled = PressureLaplacian<T, G>;
  static constexpr int kVelocity = 2 * G::kPoints;  // the pressure comes behind

  NavierStokes(const OperatorArguments& a, int64_t sample)
      : block_(a, sample), laplacian_(a, sample), per_dt_(a.numbers[0]) {}

  const Cycled& laplacian() const { return laplacian_; }
  /// The Schur complement without winds has the inverse `of_laplacian` times that of laplacian(), and `of_identity`.
  T of_laplacian() const {
    return static_cast<T>(per_dt_ / (laplacian_.largest() * static_cast<double>(this->factor())));
  }
  T of_identity() const { return static_cast<T>(block_.nu() / static_cast<double>(this->factor())); }

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
    block_.for_each_entry(at, channel * G::kPoints, wind, wind, [&](T a, int j, int, int) { f(a, j); });
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
  Cycled laplacian_;
  double per_dt_;
};

}  // namespace prdp::gpu
