#pragma once
#include <cstdint>
#include <memory>
#include <string>
#include <typeinfo>

/// The last factorisations of sparse matrices. The steps of a rollout share one operator, and so do their
/// adjoint solves where it is symmetric; a factorisation costs as much as dozens of solves.
namespace prdp::factor_cache {

using Factors = std::shared_ptr<const void>;

/// The factors kept under exactly this key, or null.
Factors find(const std::string& key);
/// Keeps them in place of older ones, unless they are too large.
void keep(std::string key, Factors factors, int64_t bytes);
/// Frees all factors.
void clear();
/// How many factors were made so far.
int64_t count_made();

/// The factors F of the matrix whose numbers are the key, from the cache or from make(). Any thread may call this.
template <class F, class Make>
std::shared_ptr<const F> find_or_make(std::string key, const Make& make) {
  key += typeid(F).name();
  if (const auto found = find(key)) return std::static_pointer_cast<const F>(found);
  const std::shared_ptr<const F> made = make();
  keep(std::move(key), made, made->bytes());
  return made;
}

/// Appends the bytes of `count` numbers to a key.
template <class T>
void append(std::string& key, const T* values, int64_t count) {
  key.append(reinterpret_cast<const char*>(values), static_cast<size_t>(count) * sizeof(T));
}

}  // namespace prdp::factor_cache
