#pragma once
#include <array>
#include <cstdint>
#include <cstring>
#include <memory>
#include <typeinfo>
#include <vector>

#include "prdp/kernels/whole_vectors.h"

/// Factorisations, hierarchies of grids and kernels of direct solves, that later solves with the same matrix use again:
/// its adjoint solve, the other steps of a rollout, the next update of a training. They are found by a hash of the
/// numbers that the matrix is made of, so that nobody has to say whether these have changed.
namespace prdp::kernels {

/// 128 bits of hash.
struct FactorKey {
  uint64_t low, high;
  bool operator==(const FactorKey&) const = default;
};

/// Hashes numbers as fast as memory delivers them.
class FactorKeyMaker {
 public:
  template <class T>
  FactorKeyMaker& add(const T* values, int64_t count) {
    return add_bytes(reinterpret_cast<const unsigned char*>(values), count * static_cast<int64_t>(sizeof(T)));
  }
  /// The same for many numbers: the hashes of blocks, which several threads may share.
  template <class T>
  FactorKeyMaker& add_field(const T* values, int64_t count) {
    std::vector<FactorKey> of_blocks((count + kBlock - 1) / kBlock);
    for_each_block_of(count, [&](int64_t i, int64_t end) {
      of_blocks[i / kBlock] = FactorKeyMaker().add(values + i, end - i).key();
    });
    return add(of_blocks.data(), static_cast<int64_t>(of_blocks.size()));
  }
  template <class T>
  FactorKeyMaker& add(T value) {
    return add(&value, 1);
  }
  FactorKey key() const;

 private:
  FactorKeyMaker& add_bytes(const unsigned char* bytes, int64_t count);

  std::array<uint64_t, 4> lanes_ = {0x9e3779b97f4a7c15, 0xbf58476d1ce4e5b9, 0x94d049bb133111eb, 0xd6e8feb86659fd93};
  uint64_t count_ = 0;
};

}  // namespace prdp::kernels

namespace prdp::factor_cache {

using Kept = std::shared_ptr<const void>;

/// What is kept under this key and type, or null.
Kept find(const kernels::FactorKey& key, const std::type_info& type);
/// Keeps it, if it is not larger than limit() bytes. What was used least recently goes once all take more than that, or
/// once so much else was made since that nothing is likely to ask for it: twice as much as between any two uses of one
/// of them so far, and 64 MiB at least. So a training with a new matrix in each update does not fill the limit.
void keep(const kernels::FactorKey& key, const std::type_info& type, Kept kept, int64_t bytes);
/// Frees all of it.
void clear();
/// How many calls of find_or_make() had to make it.
int64_t count_made();
void count_one();
/// 1 GiB.
int64_t limit();
int64_t bytes_kept();

/// The F of the matrix with this key, from the cache or from make(). Any thread may call this.
template <class F, class Make>
std::shared_ptr<const F> find_or_make(const kernels::FactorKey& key, const Make& make) {
  if (const auto found = find(key, typeid(F))) return std::static_pointer_cast<const F>(found);
  const std::shared_ptr<const F> made = make();
  count_one();
  keep(key, typeid(F), made, made->bytes());
  return made;
}

}  // namespace prdp::factor_cache
