#pragma once
#include <array>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "prdp/autograd/tape_back.h"
#include "prdp/autograd/tape_space.h"
#include "prdp/solvers/iterate.h"

namespace prdp {

/// The states of one sample that its iterations are run again from.
template <class T>
class KeptStates {
 public:
  KeptStates(int64_t length, int64_t halo) : length_(length), halo_(halo) {}
  /// Makes room; what was kept before is lost.
  void prepare(int64_t slots, int64_t vectors, int64_t numbers) {
    vectors_each_ = vectors;
    numbers_each_ = numbers;
    if (vectors_.count() < vectors * slots) vectors_.prepare(vectors * slots, length_, halo_);
    numbers_.resize(numbers * slots);
  }
  T* vector(int64_t slot, int64_t v) { return vectors_.vector(vectors_each_ * slot + v); }
  T& number(int64_t slot, int64_t s) { return numbers_[numbers_each_ * slot + s]; }

 private:
  int64_t length_, halo_, vectors_each_ = 0, numbers_each_ = 0;
  kernels::Workspace<T> vectors_;
  std::vector<T> numbers_;
};

/// The iterations of a method as they ran, for run_back(). An iteration is taken back by its operations, which the
/// space records while it runs again. What it starts from and ends with is x and what the method carries.
template <class Method, class T>
class TapeRun {
  using Space = TapeSpace<T>;
  using Vector = typename Space::Vector;
  using Number = typename Space::Scalar;

 public:
  /// The method's rtol, and ‖b‖².
  struct Stop {
    double rtol, b2;
  };
  /// Vectors and numbers of a state. x is kept where an iteration reads it.
  static constexpr int64_t kNumbers = []<class... Part>(std::tuple<Part&...>*) {
    return (int64_t{std::is_same_v<Part, Number>} + ... + 0);
  }(static_cast<decltype(std::declval<Method&>().iteration_state())*>(nullptr));
  static constexpr int64_t kVectors =
      static_cast<int64_t>(std::tuple_size_v<decltype(std::declval<Method&>().iteration_state())>) - kNumbers + 1;

  /// The cotangent of the last iterate is in x_bar, memory of the tape.
  TapeRun(Tape<T>& tape, Space& space, TapeBack<T>& back, Method method, KeptStates<T>& kept, T* x_bar, Stop stop)
      : tape_(tape), space_(space), back_(back), method_(std::move(method)), kept_(kept), stop_(stop) {
    for_each_part([&](auto& part, size_t i) {
      const bool is_x = static_cast<void*>(&part) == &method_.x;
      bars_[i] = {is_x ? x_bar : tape_.new_memory(), is_x, T(0)};
    });
  }

  void start() {
    space_.record(true);
    method_.start();
    for_each_part([&](auto& part, size_t i) { remember(part, begin_, i); });
    tape_.keep();
    space_.record(false);
    for_each_part([&](auto& part, size_t) { make_constant(part); });
    done_ = 0;
  }
  void step() {
    iterate_once();
    ++done_;
  }
  void save(int64_t slot) {
    int64_t v = 0, n = 0;
    for_each_part([&](auto& part, size_t) {
      if constexpr (is_number<decltype(part)>) kept_.number(slot, n++) = part.value;
      else if (is_read(part)) std::copy_n(space_.value(part), tape_.length(), kept_.vector(slot, v++));
    });
  }
  void load(int64_t slot, int64_t k) {
    int64_t v = 0, n = 0;
    for_each_part([&](auto& part, size_t) {
      if constexpr (is_number<decltype(part)>) space_.set(part, kept_.number(slot, n++));
      else space_.set(part, is_read(part) ? kept_.vector(slot, v++) : nullptr);
    });
    method_.resume(k);
    done_ = k;
  }
  /// Runs iteration k again, from the state at hand, and takes it back.
  void step_back(int64_t, int64_t k) {
    tape_.release();
    space_.record(true);
    const Parts before = inputs_of(k);
    method_.resume(k);
    iterate_once();
    seed_cotangents();
    back_.take_back(tape_.kept_ops(), tape_.kept_numbers());
    space_.record(false);
    if (k > 0) collect_cotangents(before);
  }
  /// The cotangent of b.
  T* finish() {
    tape_.release();
    back_.take_back(0, 0);
    return tape_.bar(space_.b().version);
  }

 private:
  template <class Part>
  static constexpr bool is_number = std::is_same_v<std::decay_t<Part>, Number>;
  struct Bar {
    T* vector;
    bool holds;
    T number;
  };
  /// A state; entry i is a vector's version or a number's node, and the other array is unused there.
  struct Parts {
    std::array<Vector, kVectors + kNumbers> vectors;
    std::array<Number, kVectors + kNumbers> numbers;
  };
  /// Notes part i of a state.
  static void remember(const Vector& part, Parts& parts, size_t i) { parts.vectors[i] = part; }
  static void remember(const Number& part, Parts& parts, size_t i) { parts.numbers[i] = part; }
  /// Makes it what was noted.
  static void recall(Vector& part, const Parts& parts, size_t i) { part.version = parts.vectors[i].version; }
  static void recall(Number& part, const Parts& parts, size_t i) { part = parts.numbers[i]; }
  /// Cuts it off from the numbers that it was made of.
  static void make_constant(Vector&) {}
  static void make_constant(Number& part) { part = part.value; }

  /// Whether an iteration reads this part of the state before it.
  bool is_read(const Vector& part) const { return &part != &method_.x || carries_x_ || stop_.rtol > 0.0; }
  /// Of x and what the method carries, each once.
  template <class Body>
  void for_each_part(const Body& body) {
    size_t i = 0;
    auto carried = method_.iteration_state();
    carries_x_ = std::apply([&](auto&... part) { return ((static_cast<void*>(&part) == &method_.x) || ...); }, carried);
    if (!carries_x_) body(method_.x, i++);
    std::apply([&](auto&... part) { (body(part, i++), ...); }, carried);
  }
  /// What the state at hand is made of: by the start, or as new inputs of iteration k alone.
  Parts inputs_of(int64_t k) {
    Parts parts = begin_;
    for_each_part([&](auto& part, size_t i) {
      if (k == 0) return recall(part, parts, i);
      if constexpr (is_number<decltype(part)>) space_.set(part, part.value);
      remember(part, parts, i);
    });
    return parts;
  }
  /// Hands the cotangents of the state after an iteration to the tape.
  void seed_cotangents() {
    for_each_part([&](auto& part, size_t i) {
      if constexpr (!is_number<decltype(part)>) {
        if (bars_[i].holds) tape_.give_bar(part.version, bars_[i].vector);
      } else if (part.node >= 0) {
        tape_.numbers[part.node].bar += bars_[i].number;
      }
    });
  }
  /// Takes those of the state before it from there.
  void collect_cotangents(const Parts& before) {
    for_each_part([&](auto& part, size_t i) {
      if constexpr (is_number<decltype(part)>) bars_[i].number = tape_.numbers[before.numbers[i].node].bar;
      else bars_[i].holds = tape_.take_bar(before.vectors[i].version, bars_[i].vector);
    });
  }
  void iterate_once() {
    detail::repeat_iteration(method_, stop_.rtol, done_, [&] {
      if (is_within(method_.residual2().value, stop_.rtol, stop_.b2)) method_.recompute_residual();
    });
  }

  Tape<T>& tape_;
  Space& space_;
  TapeBack<T>& back_;
  Method method_;
  KeptStates<T>& kept_;
  Stop stop_;
  std::array<Bar, kVectors + kNumbers> bars_{};  // of the state after the iterations that are not taken back yet
  Parts begin_;
  int64_t done_ = 0;
  bool carries_x_ = false;
};

}  // namespace prdp
