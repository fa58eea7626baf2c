#pragma once
#include <memory>
#include <utility>
#include <vector>

namespace prdp::kernels {

/// Allocates memory without a value. New pages are most of what it costs to set up a large grid, and whoever writes to
/// them first pays: so all threads fill a field, each its part.
template <class T>
struct Unset : std::allocator<T> {
  template <class U>
  struct rebind {
    using other = Unset<U>;
  };
  template <class U>
  void construct(U* at) {
    ::new (static_cast<void*>(at)) U;
  }
  template <class U, class... Values>
  void construct(U* at, Values&&... values) {
    ::new (static_cast<void*>(at)) U(std::forward<Values>(values)...);
  }
};

/// The coefficients, weights or values of a grid.
template <class T>
using Field = std::vector<T, Unset<T>>;

}  // namespace prdp::kernels
