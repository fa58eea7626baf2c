#pragma once
#include <utility>

#include "prdp/threads/interruption.h"

/// Shares the work on one sample among threads, where a batch has fewer samples than there are threads.
namespace prdp::share_rows {

/// Values in a block of a long vector. Sums are taken over blocks and then added in order, so that no bit of them
/// depends on the number of threads.
inline constexpr int64_t kBlock = 8192;

/// Whether this thread shares its loops. Threads that help never do.
bool wanted();

/// Sets that for as long as it lives.
class Scope {
 public:
  explicit Scope(bool wanted);
  Scope(const Scope&) = delete;
  ~Scope();

 private:
  bool before_;
};

/// Calls body(i) for 0 <= i < count, in any order and on several threads.
template <class Body>
void for_each(int64_t count, const Body& body) {
  const auto some = [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) body(i);
  };
  if (count > 1 && wanted()) interruption::share(0, count, 1, some);
  else some(0, count);
}

}  // namespace prdp::share_rows
