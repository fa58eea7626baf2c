#pragma once
#include "prdp/autograd/product_rows.h"
#include "prdp/autograd/tape.h"
#include "prdp/solvers/sample_space.h"

namespace prdp {

/// The reverse sweep over a tape: from the cotangents of the outputs of each operation to those of its inputs.
/// Here stands the derivative of every operation of a space, and so that of every method.
template <class T>
class TapeBack {
 public:
  using Kernel = kernels::Kernel<T>;
  /// Pairs (λ, v) come out divided by these, as they belong to the scaled sample; no rows: not wanted.
  struct Gradient {
    ProductRows* rows;
    T lambda_scale, v_scale;
  };

  TapeBack(Tape<T>& tape, SampleSpace<T>& values, const Kernel& a, const Kernel& transpose, SampleState& state,
           int32_t b, Gradient gradient)
      : tape_(tape), values_(values), a_(a), transpose_(transpose), state_(state), b_(b), gradient_(gradient) {
    for (T** own : {&minus_diagonal_bar_, &scratch_, &second_}) *own = tape_.new_memory();
  }

  /// Takes back what came after the first operations and numbers.
  void take_back(int32_t first_op, int32_t first_number) {
    int32_t node = tape_.numbers.size();
    const auto numbers_down_to = [&](int32_t first) {
      for (; node > first; --node) take_back(tape_.numbers[node - 1]);
    };
    for (int32_t i = tape_.ops.size(); i > first_op; --i) {
      const Op op = tape_.ops[i - 1];
      numbers_down_to(op.numbers);
      if (op.made >= 0) take_number_back(op, tape_.numbers[op.made].bar);
      else if (tape_.has_bar(op.out)) take_back(op, tape_.bar(op.out));
    }
    numbers_down_to(first_number);
  }
  /// Adds sign ∂⟨λ, A v⟩/∂g to A's gradient.
  void differentiate(T sign, const T* lambda, const T* v) {
    if (!gradient_.rows) return;
    a_.layout().store(lambda, sign / gradient_.lambda_scale, gradient_.rows->template lambda<T>());
    a_.layout().store(v, T(1) / gradient_.v_scale, gradient_.rows->template v<T>());
    gradient_.rows->push();
  }
  T* minus_diagonal_bar() { return minus_diagonal_bar_; }

 private:
  using Kind = typename Tape<T>::Kind;
  using Op = typename Tape<T>::Op;

  void take_back(const NumberNode<T>& node) {
    if (node.bar == T(0)) return;
    for (int i = 0; i < 2; ++i)
      if (node.of[i] >= 0) tape_.numbers[node.of[i]].bar += node.derivative[i] * node.bar;
  }
  void take_number_back(const Op& op, T bar) {
    if (bar == T(0)) return;
    const T *const a = tape_.value(op.a), *const b = op.b < 0 ? nullptr : tape_.value(op.b);
    switch (op.kind) {
      case Kind::kSquare: return tape_.add_bar(op.a, 2 * bar, a);
      default:  // kDot
        tape_.add_bar(op.a, bar, b);
        return tape_.add_bar(op.b, bar, a);
    }
  }
  void take_back(const Op& op, T* bar) {
    switch (op.kind) {
      case Kind::kAxpy:
        add_to_number(op.factor_node, op.sign, bar, op.b);
        tape_.add_bar(op.b, op.sign * op.factor, bar);
        return tape_.move_bar(op.out, op.a);
      case Kind::kCombination:
        for (int32_t i = op.first_term; i < op.first_term + op.count; ++i) {
          const auto term = tape_.terms[i];
          add_to_number(term.node, op.sign, bar, term.of);
          tape_.add_bar(term.of, term.factor, bar);
        }
        if (op.factor != T(1)) return tape_.add_bar(op.a, op.factor, bar);
        return tape_.move_bar(op.out, op.a);
      case Kind::kApply:
        if (values_.projects_products()) values_.project(bar);
        return product_back(op.a, 1, bar);
      case Kind::kResidual:
        values_.project(bar);
        tape_.add_bar(b_, 1, bar);
        return product_back(op.a, -1, bar);
      case Kind::kDivide:
        a_.divide_by_diagonal(bar, scratch_);
        if (gradient_.rows) {
          vectors_.weigh(scratch_, tape_.value(op.out), second_, length());
          vectors_.axpy(T(1), second_, minus_diagonal_bar_, length());
        }
        return tape_.add_bar(op.a, 1, scratch_);
      case Kind::kPrecondition: values_.precondition_transpose(bar, scratch_); return tape_.add_bar(op.a, 1, scratch_);
      case Kind::kSweep: return sweep_back(op, bar);
      default: TORCH_INTERNAL_ASSERT(false, "an operation that makes a number");
    }
  }
  void sweep_back(const Op& op, T* bar) {
    tape_.add_bar(op.a, 1, bar);
    tape_.add_bar(op.b, 1, bar);
    a_.divide_by_diagonal(bar, second_);
    if (gradient_.rows) {  // D⁻¹A x = x + c - next
      const T *c = tape_.value(op.a), *x = tape_.value(op.b), *next = tape_.value(op.out);
      for (int64_t i = 0; i < length(); ++i) minus_diagonal_bar_[i] -= second_[i] * (x[i] + c[i] - next[i]);
    }
    product_back(op.b, -1, second_);
  }
  void add_to_number(int32_t node, T sign, const T* bar, int32_t of) {
    if (node >= 0) tape_.numbers[node].bar += sign * vectors_.dot(bar, tape_.value(of), length());
  }
  /// The cotangent of v for that of A v, or minus it; and the share of A's gradient.
  void product_back(int32_t of, T sign, const T* lambda) {
    if (of == Tape<T>::kZero) return;
    ++state_.applications;
    if (!tape_.has_bar(of) && sign == T(1)) {
      transpose_.apply(lambda, tape_.new_bar(of));
    } else {
      transpose_.apply(lambda, scratch_);
      tape_.add_bar(of, sign, scratch_);
    }
    differentiate(sign, lambda, tape_.value(of));
  }
  int64_t length() const { return tape_.length(); }

  kernels::WholeVectors<T> vectors_;
  Tape<T>& tape_;
  SampleSpace<T>& values_;
  const Kernel &a_, &transpose_;
  SampleState& state_;
  int32_t b_;
  Gradient gradient_;
  T *minus_diagonal_bar_, *scratch_, *second_;
};

}  // namespace prdp
