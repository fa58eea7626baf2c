#pragma once
#include <cstring>
#include <memory>
#include <utility>
#include <vector>

#include "prdp/autograd/tape_number.h"
#include "prdp/kernels/vector.h"
#include "prdp/kernels/whole_vectors.h"

namespace prdp {

/// Memory for vectors of one length; it grows as needed.
template <class T>
class VectorPool {
 public:
  VectorPool(int64_t length, int64_t halo) : length_(length), halo_(halo) {}
  T* take() {
    if (free_.empty()) {
      chunks_.push_back(std::make_unique<kernels::Workspace<T>>());
      list(*chunks_.back());
    }
    T* taken = free_.back();
    free_.pop_back();
    return taken;
  }
  void give_back(T* vector) { free_.push_back(vector); }
  /// Takes all back and zeroes it with the padding, where a number that is not finite may have got to.
  void reset() {
    free_.clear();
    for (auto& chunk : chunks_) list(*chunk);
  }

 private:
  static constexpr int64_t kChunk = 8;

  void list(kernels::Workspace<T>& chunk) {
    chunk.prepare(kChunk, length_, halo_);
    for (int64_t i = kChunk; i > 0; --i) free_.push_back(chunk.vector(i - 1));
  }

  int64_t length_, halo_;
  std::vector<std::unique_ptr<kernels::Workspace<T>>> chunks_;
  std::vector<T*> free_;
};

/// What the iterations of one sample leave behind so that they can be taken back: the vectors that they made (each
/// value that a vector had is a version), their numbers, and the operations between them.
template <class T>
class Tape {
 public:
  enum class Kind : int8_t {
    kAxpy,         // out = a + sign factor b
    kCombination,  // out = factor a + sign Σ of the terms
    kApply,        // out = A a
    kResidual,     // out = the right-hand side - A a
    kDivide,       // out = D⁻¹ a
    kPrecondition, // out = M⁻¹ a, M being a constant
    kSweep,        // out = b + a - D⁻¹A b
    kDot,          // made = a·b
    kSquare        // made = ‖a‖²
  };
  /// An operation: versions of vectors, and nodes of numbers.
  struct Op {
    Kind kind;
    int32_t out = -1, a = -1, b = -1, made = -1, factor_node = -1;
    T factor = 1;
    int8_t sign = 1;
    int32_t first_term = 0, count = 0;  // of a combination
    int32_t numbers = 0;                // nodes before it
  };
  struct Term {
    int32_t of, node;
    T factor;
  };
  /// A version of a vector that is always zero.
  static constexpr int32_t kZero = 0;

  Tape(int64_t length, int64_t halo) : length_(length), pool_(length, halo) {}

  /// Forgets the sample before.
  void begin() {
    cut_to({});
    pool_.reset();
    add_version();
  }
  /// What is here now stays until begin(), and what comes after it until the next release().
  void keep() {
    for (int32_t i = 0; i < versions_.size(); ++i)
      if (!versions_[i].bar) versions_[i].bar = pool_.take();
    kept_ = {ops.size(), numbers.size(), versions_.size(), terms.size()};
  }
  void release() {
    for (int32_t i = versions_.size(); i > kept_.versions; --i) {
      const auto& version = versions_[i - 1];
      if (version.is_read) pool_.give_back(version.value);
      if (version.bar) pool_.give_back(version.bar);
    }
    cut_to(kept_);
  }

  int32_t add_version() { return versions_.push({pool_.take()}); }
  int32_t add_version(T* memory) { return versions_.push({memory}); }
  /// One in the memory of another, whose value nobody reads.
  int32_t add_unread(T* memory) { return versions_.push({memory, nullptr, false, /*is_read=*/false}); }
  T* value(int32_t version) const { return versions_[version].value; }
  bool is_read(int32_t version) const { return versions_[version].is_read; }
  /// The version begins anew, without a cotangent.
  void begin_version(int32_t version, bool is_read) {
    versions_[version].has_bar = false;
    versions_[version].is_read = is_read;
  }
  T* new_memory() { return pool_.take(); }

  // ---- cotangents
  bool has_bar(int32_t version) const { return versions_[version].has_bar; }
  /// The cotangent to write all of to.
  T* new_bar(int32_t version) {
    auto& v = versions_[version];
    if (!v.bar) v.bar = pool_.take();
    v.has_bar = true;
    return v.bar;
  }
  /// The cotangent; zeros where nothing was added to it.
  T* bar(int32_t version) {
    const bool held = has_bar(version);
    T* const bar = new_bar(version);
    if (!held) std::memset(bar, 0, bytes());
    return bar;
  }
  void add_bar(int32_t version, T factor, const T* x) {
    if (version == kZero || factor == T(0)) return;
    if (has_bar(version)) vectors_.axpy(factor, x, versions_[version].bar, length_);
    else vectors_.scale(factor, x, new_bar(version), length_);
  }
  /// Adds x, whose memory may be exchanged for other memory.
  void give_bar(int32_t version, T*& x) {
    if (version == kZero || has_bar(version)) return add_bar(version, 1, x);
    new_bar(version);
    std::swap(versions_[version].bar, x);
  }
  void move_bar(int32_t from, int32_t to) { give_bar(to, versions_[from].bar); }
  /// The cotangent, in exchange for other memory; whether there is one.
  bool take_bar(int32_t version, T*& x) {
    std::swap(versions_[version].bar, x);
    return std::exchange(versions_[version].has_bar, false);
  }

  int64_t length() const { return length_; }
  size_t bytes() const { return static_cast<size_t>(length_) * sizeof(T); }
  int32_t kept_ops() const { return kept_.ops; }
  int32_t kept_numbers() const { return kept_.numbers; }

  Log<Op> ops;
  Log<Term> terms;
  Log<NumberNode<T>> numbers;

 private:
  struct Version {
    T* value;
    T* bar = nullptr;
    bool has_bar = false;
    bool is_read = true;
  };
  struct Mark {
    int32_t ops = 0, numbers = 0, versions = 0, terms = 0;
  };
  void cut_to(const Mark& mark) {
    ops.cut_to(mark.ops);
    numbers.cut_to(mark.numbers);
    versions_.cut_to(mark.versions);
    terms.cut_to(mark.terms);
  }

  kernels::WholeVectors<T> vectors_;
  int64_t length_;
  VectorPool<T> pool_;
  Log<Version> versions_;
  Mark kept_;
};

}  // namespace prdp
