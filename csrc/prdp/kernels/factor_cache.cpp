#include "prdp/kernels/factor_cache.h"

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <bit>
#include <list>
#include <mutex>
#include <typeindex>
#include <unordered_map>
#include <vector>

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
  Kept kept;  // null once it has gone; its name stays a while
  int64_t bytes;
  int64_t used_at;  // bytes_made then
};
using Entries = std::list<Entry>;  // the last used first

std::mutex mutex;
// A fork waits for the threads that hold it, as its child has none to unlock it.
[[maybe_unused]] const int watches_forks =
    pthread_atfork([] { mutex.lock(); }, [] { mutex.unlock(); }, [] { mutex.unlock(); });
// Never destroyed: at the end of a process, memory of a device can no longer be freed.
auto& entries = *new Entries;
auto& evicted_names = *new Entries;
auto& places = *new std::unordered_map<Name, Entries::iterator, HashOfName>;
int64_t bytes_of_all = 0, bytes_made = 0;
constexpr int64_t kLeastRetention = int64_t{1} << 26;
int64_t retention_bytes = kLeastRetention;
std::atomic<int64_t> made = 0;

/// Moves an entry of `entries` to the names of what has gone; what it kept goes with `gone`.
void evict(Entries::iterator entry, std::vector<Kept>& gone) {
  bytes_of_all -= entry->bytes;
  gone.push_back(std::move(entry->kept));
  evicted_names.splice(evicted_names.begin(), entries, entry);
}

/// Frees what has not been used while so much else was made, or takes too much memory, and forgets the oldest names.
void make_room(std::vector<Kept>& gone) {
  while (!entries.empty() && (bytes_of_all > limit() || bytes_made - entries.back().used_at > retention_bytes))
    evict(std::prev(entries.end()), gone);
  while (!evicted_names.empty() && bytes_made - evicted_names.back().used_at > limit()) {
    places.erase(evicted_names.back().name);
    evicted_names.pop_back();
  }
}

}  // namespace

int64_t limit() { return int64_t{1} << 30; }
int64_t bytes_kept() {
  const std::lock_guard lock(mutex);
  return bytes_of_all;
}

Kept find(const kernels::FactorKey& key, const std::type_info& type) {
  const std::lock_guard lock(mutex);
  const auto place = places.find({key, type});
  if (place == places.end()) return nullptr;
  const auto entry = place->second;
  retention_bytes = std::max(retention_bytes, std::min(limit(), 2 * (bytes_made - entry->used_at)));
  if (!entry->kept) return nullptr;
  entry->used_at = bytes_made;
  entries.splice(entries.begin(), entries, entry);
  return entry->kept;
}

void keep(const kernels::FactorKey& key, const std::type_info& type, Kept kept, int64_t bytes) {
  std::vector<Kept> gone;  // destroyed without the lock
  const std::lock_guard lock(mutex);
  constexpr int64_t of_objects = 4096;  // beside its numbers, about, as measured on small grids
  bytes += of_objects;
  if (bytes > limit()) return;
  const Name name{key, type};
  if (const auto place = places.find(name); place != places.end()) {
    if (place->second->kept) evict(place->second, gone);  // another thread made it too
    evicted_names.erase(place->second);
  }
  bytes_made += bytes;
  bytes_of_all += bytes;
  entries.push_front({name, std::move(kept), bytes, bytes_made});
  places[name] = entries.begin();
  make_room(gone);
}

void clear() {
  Entries gone;
  const std::lock_guard lock(mutex);
  gone.swap(entries);
  evicted_names.clear();
  places.clear();
  bytes_of_all = 0;
  retention_bytes = kLeastRetention;
}

void count_one() { ++made; }
int64_t count_made() { return made; }

}  // namespace prdp::factor_cache
