#pragma once
#include "prdp/gpu/device/views.h"

/// shift·u - ∇·(κ ∇u) on the cells of a box, made of κ in each product.
namespace prdp::gpu {

/// What holds at a side, as prdp::Side counts.
inline constexpr int kZeroSide = 0, kPeriodicSide = 2, kRobinSide = 3;

/// The same for each channel. The sides are those of z, y and x, the low one first. Numbers: the shift; 1/h along z, y
/// and x; h of each side where that is a number. Tensors, where they are there: κ, one for all axes or one for each of
/// the last kKappas axes, the shift, h of each side.
template <class T, class G, int kChannels, bool kHarmonic, int kKappas, int... kSides>
class Diffusion : public OperatorRows<Diffusion<T, G, kChannels, kHarmonic, kKappas, kSides...>, T> {
 public:
  static constexpr int kUnknowns = kChannels * G::kPoints;

  Diffusion(const OperatorArguments& a, int64_t sample) {
    const auto field = [&](int k) {
      const T* const first = static_cast<const T*>(a.tensors[k]);
      return first ? first + sample * a.sample_strides[k] : nullptr;
    };
    using namespace diffusion_slots;
    kappa_ = field(kKappa);
    shift_ = field(kShift);
    shift_number_ = static_cast<T>(a.numbers[kShiftNumber]);
    for (int axis = 0; axis < 3; ++axis) inverse_width_[axis] = static_cast<T>(a.numbers[kInverseWidth + axis]);
    for (int side = 0; side < 6; ++side) {
      robin_[side] = field(kRobin + side);
      robin_number_[side] = static_cast<T>(a.numbers[kRobinNumber + side]);
    }
  }

  /// Whether the shift and the Robin sides alone hold u, and A is singular where they are zero.
  static constexpr bool kMayBeUnheld = ((kSides != kZeroSide) && ...);

  static constexpr bool kLoadsEnough = true;

  using Cycled = Diffusion;
  using Points = G;
  static constexpr bool periodic(int axis) { return side(axis, 0) == kPeriodicSide; }
  /// NaN where κ is not allowed.
  T largest_in_row(int i) const {
    bool allowed = true;
    for (int k = 0; k < kKappas; ++k) allowed = allowed && !(kappa_[int64_t{k} * G::kPoints + i % G::kPoints] <= T(0));
    return allowed ? OperatorRows<Diffusion, T>::largest_in_row(i) : std::numeric_limits<T>::quiet_NaN();
  }
  template <class F>
  void for_each_entry(int i, const F& f) const {
    T through = 0;
    const T row_sum = for_each_face(i, [&](T c, int j, int, int) {
      through += c;
      f(-c, j);
    });
    f(row_sum + through, i);
  }
  template <class F>
  void for_each_offset(int point, const F& f) const {
    T through = 0;
    const auto report = [&](T c, int axis, int cells) {
      f(-c, axis == 0 ? cells : 0, axis == 1 ? cells : 0, axis == 2 ? cells : 0);
    };
    const auto inside = [&](T c, int, int axis, int cells) {
      through += c;
      report(c, axis, cells);
    };
    const T row_sum = for_each_face(point, inside, report);
    f(row_sum + through, 0, 0, 0);
  }
  /// Of row i: the shift and what the sides add. A is definite if that is never negative, and not always zero.
  T row_sum(int i) const {
    return for_each_face(i, [](T, int, int, int) {});
  }
  /// By differences, which no coefficient rounds away.
  template <class V>
  T product(const V& v, int i) const {
    T flux = 0;
    const T centre = v[i];
    const int channel = i - i % G::kPoints;
    const Around values(G(i % G::kPoints), [&](int, int there) { return v[channel + there]; });
    const auto add = [&](T c, int, int axis, int cells) { flux += c * (centre - values.of[2 * axis + (cells > 0)]); };
    const T row_sum = for_each_face(i, add);
    return this->factor() * (row_sum * centre + flux);
  }

 private:
  struct Nothing {
    void operator()(T, int, int) const {}
  };
  /// Of the low end of an axis, 0, or of its high one, 1.
  static constexpr int side(int axis, int end) {
    constexpr int sides[] = {kSides...};
    return sides[2 * axis + end];
  }
  /// f(c, j, axis, cells) for each face to a neighbour j, so many cells along the axis, and beyond(c, axis, cells) for
  /// each on a side that holds u; returns the shift and what the sides hold.
  template <class F, class Beyond = Nothing>
  T for_each_face(int i, const F& f, const Beyond& beyond = {}) const {
    const int point = i % G::kPoints;
    const G at(point);
    T row_sum = shift_ ? shift_[point] : shift_number_;
    for (int k = 0; k < kKappas; ++k)
      row_sum += T(0) * kappa_[int64_t{k} * G::kPoints + point];  // NaN where κ is not finite
    const Around kappa(at, [&](int axis, int there) { return kappa_of(axis)[there]; });
    row_sum += face<0, 0>(at, i, kappa, f, beyond) + face<0, 1>(at, i, kappa, f, beyond);
    row_sum += face<1, 0>(at, i, kappa, f, beyond) + face<1, 1>(at, i, kappa, f, beyond);
    row_sum += face<2, 0>(at, i, kappa, f, beyond) + face<2, 1>(at, i, kappa, f, beyond);
    return row_sum;
  }
  /// The κ of an axis. Those of one cell need none.
  const T* kappa_of(int axis) const {
    const int own = axis + kKappas - 3;
    return kappa_ + (kKappas == 1 || own < 0 ? int64_t{0} : int64_t{own}) * G::kPoints;
  }
  /// The neighbour beyond a face, or -1.
  template <int axis, int end>
  static int neighbour(const G& at) {
    constexpr int extents[] = {G::kZ, G::kY, G::kX}, n = extents[axis];
    constexpr bool wraps = side(axis, end) == kPeriodicSide && n > 1;
    const int here = axis == 0 ? at.z : axis == 1 ? at.y : at.x;
    const int next = moved<n, end == 0 ? -1 : 1, wraps>(here);
    constexpr int stride = axis == 0 ? G::kY * G::kX : axis == 1 ? G::kX : 1;
    return next < 0 ? -1 : at.point() + (next - here) * stride;
  }
  /// get(axis, there) for the neighbour beyond each face, or for the cell itself: loads without a branch, so that none
  /// waits for another.
  struct Around {
    template <class Get>
    Around(const G& at, const Get& get) {
      set<0>(at, get);
      set<1>(at, get);
      set<2>(at, get);
    }
    template <int axis, class Get>
    void set(const G& at, const Get& get) {
      const int below = neighbour<axis, 0>(at), above = neighbour<axis, 1>(at);
      of[2 * axis] = get(axis, below < 0 ? at.point() : below);
      of[2 * axis + 1] = get(axis, above < 0 ? at.point() : above);
    }
    T of[6];
  };
  template <int axis, int end, class F, class Beyond>
  T face(const G& at, int i, const Around& around, const F& f, const Beyond& beyond) const {
    constexpr int cells = end == 0 ? -1 : 1;
    const int point = at.point(), there = neighbour<axis, end>(at);
    const T scale = inverse_width_[axis] * inverse_width_[axis], kappa = kappa_of(axis)[point];
    if (there >= 0) {
      f(scale * mean(kappa, around.of[2 * axis + end]), i - point + there, axis, cells);
      return 0;
    }
    if constexpr (side(axis, end) != kZeroSide && side(axis, end) != kRobinSide) return 0;
    const T conductance = side_conductance<axis, end>(at, 2 * scale * kappa);
    beyond(conductance, axis, cells);
    return conductance;
  }
  /// By the side, half a cell away.
  template <int axis, int end>
  T side_conductance(const G& at, T within) const {
    if constexpr (side(axis, end) == kZeroSide) return within;
    constexpr int at_side = 2 * axis + end;
    const int on_side = axis == 0 ? at.y * G::kX + at.x : axis == 1 ? at.z * G::kX + at.x : at.z * G::kY + at.y;
    const T h = robin_[at_side] ? robin_[at_side][on_side] : robin_number_[at_side];
    if (h < T(0)) return std::numeric_limits<T>::quiet_NaN();  // not allowed
    const T outside = inverse_width_[axis] * h;
    const T smaller = within < outside ? within : outside, larger = within < outside ? outside : within;
    return smaller / (1 + smaller / larger);  // in series, and h may be infinite
  }
  static T mean(T a, T b) { return kHarmonic ? 2 * a * (b / (a + b)) : (a + b) / 2; }

  const T *kappa_, *shift_, *robin_[6];
  T shift_number_, inverse_width_[3], robin_number_[6];
};

}  // namespace prdp::gpu
