#include "prdp/kernels/factor_cache.h"

#include <atomic>
#include <bit>
#include <list>
#include <mutex>
#include <typeindex>
#include <unordered_map>

namespace prdp::kernels {

namespace {

constexpr uint64_t kMultiplier = 0x9fb21c651e98df25;

uint64_t mixed(uint64_t h) {
  h ^= h >> 32;
  h *= kMultiplier;
  h ^= h >> 29;
  h *= 0xbf58476d1ce4e5b9;
  return h ^ (h >> 32);
}

/// The lanes with 32 bytes more.
std::array<uint64_t, 4> combined(std::array<uint64_t, 4> lanes, const unsigned char* bytes) {
  for (size_t i = 0; i < lanes.size(); ++i) {
    uint64_t word;
    std::memcpy(&word, bytes + 8 * i, sizeof(word));
    lanes[i] = std::rotl(lanes[i] ^ word, 29) * kMultiplier;
  }
  return lanes;
}

}  // namespace

FactorKeyMaker& FactorKeyMaker::add_bytes(const unsigned char* bytes, int64_t count) {
  count_ = mixed(count_ ^ static_cast<uint64_t>(count));
  auto lanes = lanes_;  // in registers: `bytes` might point into this object
  int64_t at = 0;
  for (; at + 32 <= count; at += 32) lanes = combined(lanes, bytes + at);
  if (at < count) {
    unsigned char rest[32] = {};
    std::memcpy(rest, bytes + at, static_cast<size_t>(count - at));
    lanes = combined(lanes, rest);
  }
  lanes_ = lanes;
  return *this;
}

FactorKey FactorKeyMaker::key() const {
  uint64_t low = count_, high = ~count_;
  for (int i = 0; i < 4; ++i) {
    low = mixed(low ^ lanes_[i]);
    high = mixed(std::rotl(high, 17) + lanes_[3 - i]);
  }
  return {low, high};
}

}  // namespace prdp::kernels

namespace prdp::factor_cache {

namespace {

struct Name {
  kernels::FactorKey key;
  std::type_index type;
  bool operator==(const Name&) const = default;
};
struct HashOfName {
  size_t operator()(const Name& name) const { return name.key.low ^ name.type.hash_code(); }
};
struct Entry {
  Name name;
  Kept kept;
  int64_t bytes;
};

std::mutex mutex;
// Never destroyed: at the end of a process, memory of a device can no longer be freed.
auto& entries = *new std::list<Entry>;  // the last used first
auto& places = *new std::unordered_map<Name, std::list<Entry>::iterator, HashOfName>;
int64_t bytes_of_all = 0;
std::atomic<int64_t> made = 0;

}  // namespace

int64_t limit() { return int64_t{1} << 29; }

Kept find(const kernels::FactorKey& key, const std::type_info& type) {
  const std::lock_guard lock(mutex);
  const auto place = places.find({key, type});
  if (place == places.end()) return nullptr;
  entries.splice(entries.begin(), entries, place->second);
  return entries.front().kept;
}

void keep(const kernels::FactorKey& key, const std::type_info& type, Kept kept, int64_t bytes) {
  std::list<Entry> gone;  // destroyed without the lock
  const std::lock_guard lock(mutex);
  if (bytes > limit()) return;
  const auto free = [&gone](std::list<Entry>::iterator entry) {
    bytes_of_all -= entry->bytes;
    places.erase(entry->name);
    gone.splice(gone.begin(), entries, entry);
  };
  const Name name{key, type};
  if (const auto place = places.find(name); place != places.end()) free(place->second);  // another thread made it too
  entries.push_front({name, std::move(kept), bytes});
  places[name] = entries.begin();
  bytes_of_all += bytes;
  while (bytes_of_all > limit()) free(std::prev(entries.end()));
}

void clear() {
  std::list<Entry> gone;
  const std::lock_guard lock(mutex);
  gone.swap(entries);
  places.clear();
  bytes_of_all = 0;
}

void count_one() { ++made; }
int64_t count_made() { return made; }

}  // namespace prdp::factor_cache
