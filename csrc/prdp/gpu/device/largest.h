#pragma once

/// The largest of numbers that are not negative, which NaN is not lost among.
namespace prdp::gpu {

/// The larger one; NaN if one of them is.
template <class T>
T larger_or_nan(T a, T b) {
  return b > a || b != b ? b : a;
}

/// The largest f(i), with the same bits in every thread of the team; infinite if one is not finite.
template <class Team, class F>
auto largest_of(Team& team, int n, const F& f) {
  decltype(f(0)) most = 0;
  team.template each<1>(n, f, [&](int, auto value) { most = larger_or_nan(most, value); });
  return team.largest(most);
}

}  // namespace prdp::gpu
