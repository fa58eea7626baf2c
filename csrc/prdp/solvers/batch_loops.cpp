#include "prdp/solvers/batch_loops.h"

#include <algorithm>
#include <cmath>

#include "prdp/solvers/any_length.h"
#include "prdp/solvers/sample_numbers.h"
#include "prdp/threads/share_samples.h"

namespace prdp::batch_loops {

namespace {

int64_t unknowns(const at::Tensor& v) { return v.numel() / v.size(0); }

template <class T>
const T* data(const at::Tensor& t) {
  TORCH_INTERNAL_ASSERT(t.is_contiguous());
  return t.const_data_ptr<T>();
}
/// One for each sample of v.
template <class T>
const T* numbers(const at::Tensor& t, const at::Tensor& v) {
  TORCH_INTERNAL_ASSERT(t.numel() == v.size(0));
  return data<T>(t);
}
/// The memory of v, which nobody else refers to from here on.
template <class T>
T* own(at::Tensor& v) {
  TORCH_INTERNAL_ASSERT(v.is_contiguous());
  if (v.use_count() > 1 || v.storage().use_count() > 1) v = v.clone(at::MemoryFormat::Contiguous);
  return v.mutable_data_ptr<T>();
}

at::Tensor numbers_like(const at::Tensor& v) {
  std::vector<int64_t> shape(v.dim(), 1);
  shape[0] = v.size(0);
  return at::empty(shape, v.options());
}

bool goes_on(const Active& active, int64_t sample) { return active.empty() || active[sample]; }

/// Calls body(sample, its first entry) for each sample of v, on all threads where that pays.
template <class Body>
void for_each_sample(const at::Tensor& v, const Body& body) {
  constexpr int64_t worthwhile = int64_t{1} << 18;  // entries for a thread
  const int64_t n = unknowns(v);
  share_samples(v.size(0), n, std::max<int64_t>(1, worthwhile / n), [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) body(s, s * n);
  });
}

template <class Body>
auto with_type(const at::Tensor& t, const Body& body) {
  return t.scalar_type() == at::kFloat ? body(float{}) : body(double{});
}

/// of_sample(s, its number in each of `numbers`…) of each sample s.
template <class OfSample, class... Numbers>
Scalar of_each_number(const OfSample& of_sample, const Scalar& first, const Numbers&... others) {
  auto found = at::empty_like(first);
  with_type(first, [&]<class T>(T) {
    const auto loop = [&, to = found.template mutable_data_ptr<T>()](const auto*... numbers) {
      for (int64_t s = 0; s < first.numel(); ++s) to[s] = of_sample(s, numbers[s]...);
    };
    loop(data<T>(first), data<T>(others)...);
  });
  return found;
}

}  // namespace

thread_local bool is_off = false;
Off::Off() { is_off = true; }
Off::~Off() { is_off = false; }

bool take(const at::Tensor& b) { return !is_off && b.is_cpu() && b.is_contiguous() && b.numel() > 0; }

at::Tensor dot(const Vector& a, const Vector& b) {
  auto found = numbers_like(a);
  with_type(a, [&]<class T>(T) {
    const T *left = data<T>(a), *right = data<T>(b);
    T* to = found.mutable_data_ptr<T>();
    const AnyLength<T> loops;
    for_each_sample(a, [&](int64_t s, int64_t at) { to[s] = loops.dot(left + at, right + at, unknowns(a)); });
  });
  return found;
}

at::Tensor largest_magnitude(const Vector& v) {
  auto found = at::empty({v.size(0)}, v.options());
  with_type(v, [&]<class T>(T) {
    const T* from = data<T>(v);
    T* to = found.mutable_data_ptr<T>();
    const AnyLength<T> loops;
    for_each_sample(v, [&](int64_t s, int64_t at) { to[s] = loops.largest_magnitude(from + at, unknowns(v)); });
  });
  return found;
}

void scale(const Scalar& factor, const Vector& v, Vector& out) {
  with_type(v, [&]<class T>(T) {
    T* to = own<T>(out);
    const T *from = data<T>(v), *times = numbers<T>(factor, v);
    const AnyLength<T> loops;
    for_each_sample(v, [&](int64_t s, int64_t at) { loops.scale(times[s], from + at, to + at, unknowns(v)); });
  });
}

std::array<Scalar, 2> scale_with_dots(const Scalar& factor, const Vector& v, const Vector& w, Vector& out) {
  std::array<Scalar, 2> found{numbers_like(v), numbers_like(v)};
  with_type(v, [&]<class T>(T) {
    T *to = own<T>(out), *along = found[0].mutable_data_ptr<T>(), *square = found[1].mutable_data_ptr<T>();
    const T *from = data<T>(v), *with = data<T>(w), *times = numbers<T>(factor, v);
    const AnyLength<T> loops;
    for_each_sample(v, [&](int64_t s, int64_t at) {
      const auto dots = loops.scale_with_dots(times[s], from + at, with + at, to + at, unknowns(v));
      along[s] = dots[0];
      square[s] = dots[1];
    });
  });
  return found;
}

void xpby(const Vector& x, const Scalar& beta, Vector& y, const Active& active) {
  with_type(y, [&]<class T>(T) {
    T* to = own<T>(y);
    const T *from = data<T>(x), *factor = numbers<T>(beta, y);
    const AnyLength<T> loops;
    for_each_sample(y, [&](int64_t s, int64_t at) {
      if (goes_on(active, s)) loops.xpby(from + at, factor[s], to + at, unknowns(y));
    });
  });
}

at::Tensor update_iterate_and_residual(const Scalar& alpha, const Vector& p, const Vector& q, Vector& x, Vector& r,
                                       const Active& active) {
  auto rr = numbers_like(r);
  with_type(r, [&]<class T>(T) {
    T *to_x = own<T>(x), *to_r = own<T>(r), *square = rr.mutable_data_ptr<T>();
    const T *along = data<T>(p), *taken = data<T>(q), *factor = numbers<T>(alpha, r);
    const AnyLength<T> loops;
    for_each_sample(r, [&](int64_t s, int64_t at) {
      const int64_t n = unknowns(r);
      square[s] = goes_on(active, s)
                      ? loops.update_iterate_and_residual(factor[s], along + at, taken + at, to_x + at, to_r + at, n)
                      : loops.dot(to_r + at, to_r + at, n);
    });
  });
  return rr;
}

void add_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, Vector& x, const Active& active) {
  with_type(x, [&]<class T>(T) {
    T* to = own<T>(x);
    for_each_sample(x, [&](int64_t s, int64_t at) {
      if (!goes_on(active, s)) return;
      std::vector<const T*> vectors(count);
      std::vector<T> weights(count);
      for (int64_t i = 0; i < count; ++i) vectors[i] = data<T>(v[i]) + at, weights[i] = numbers<T>(h[i], x)[s];
      AnyLength<T>().multi_axpy(T(1), weights.data(), vectors.data(), count, T(1), to + at, unknowns(x));
    });
  });
}

namespace {
/// The first `count` rows of sample s of v, (m, batch, …).
template <class T>
std::vector<T*> rows_of(const at::Tensor& v, int64_t s, int64_t n, int64_t count) {
  std::vector<T*> rows(count);
  for (int64_t i = 0; i < count; ++i) rows[i] = v.mutable_data_ptr<T>() + (i * v.size(1) + s) * n;
  return rows;
}
}  // namespace

void orthogonalise(const at::Tensor& v, int64_t j, double least, Vector& w, const std::vector<double*>& h) {
  const int64_t m = v.size(0), n = unknowns(w);
  with_type(w, [&]<class T>(T) {
    T* const taken = own<T>(w);
    for_each_sample(w, [&](int64_t s, int64_t at) {
      const AnyLength<T> loops;
      const auto rows = rows_of<T>(v, s, n, std::min(j + 2, m));
      if (h[s] == nullptr) {
        if (j + 1 < m) std::fill_n(rows[j + 1], n, T(0));
        return;
      }
      std::vector<T> along(j + 1);
      T square = 0;
      for (int pass = 0; pass < 2; ++pass) {
        loops.multi_dot(rows.data(), j + 1, T(1), taken + at, along.data(), n);
        square = loops.multi_axpy(T(-1), along.data(), rows.data(), j + 1, T(1), taken + at, n);
        for (int64_t i = 0; i <= j; ++i) h[s][i] = static_cast<double>(along[i]) + (pass == 0 ? 0.0 : h[s][i]);
      }
      h[s][j + 1] = std::sqrt(static_cast<double>(square));
      if (j + 1 < m) loops.scale(static_cast<T>(1.0 / std::max(h[s][j + 1], least)), taken + at, rows[j + 1], n);
    });
  });
}

Vector combination(const at::Tensor& v, const at::Tensor& y) {
  auto sum = at::zeros_like(v[0]);
  with_type(v, [&]<class T>(T) {
    T* const to = sum.mutable_data_ptr<T>();
    for_each_sample(sum, [&](int64_t s, int64_t at) {
      const auto rows = rows_of<T>(v, s, unknowns(sum), v.size(0));
      const double* const mine = y.const_data_ptr<double>() + s * v.size(0);
      const std::vector<T> weights(mine, mine + v.size(0));
      AnyLength<T>().multi_axpy(T(1), weights.data(), rows.data(), v.size(0), T(1), to + at, unknowns(sum));
    });
  });
  return sum;
}

bool any(const Scalar& where) {
  return with_type(where, [&]<class T>(T) {
    const T* values = data<T>(where);
    return std::any_of(values, values + where.numel(), [](T value) { return value != T(0); });
  });
}

Scalar sum_of_squares(const Scalar& v2, const Scalar& a, const Scalar& w2) {
  const auto of_sample = []<class T>(int64_t, T v, T factor, T w) {
    return SampleNumbers<T>::sum_of_squares(v, factor, w);
  };
  return of_each_number(of_sample, v2, a, w2);
}

Scalar ratio(const Scalar& num, const Scalar& den) {
  return of_each_number([]<class T>(int64_t, T n, T d) { return SampleNumbers<T>::ratio(n, d); }, num, den);
}

Scalar breaks_down(const Scalar& den, const Scalar& v2, const Scalar& w2, const Scalar& active) {
  const auto of_sample = []<class T>(int64_t, T d, T v, T w, T on) {
    return SampleNumbers<T>::breaks_down(d, v, w, on);
  };
  return of_each_number(of_sample, den, v2, w2, active);
}

Quotient guarded_quotient(const Scalar& num, const Scalar& den, const Scalar& v2, const Scalar& w2) {
  Quotient quotient;
  const auto of_sample = [&]<class T>(int64_t s, T n, T d, T v, T w) {
    bool breaks = false;
    const T value = SampleNumbers<T>::guarded_quotient(n, d, v, w, breaks);
    if (breaks) {
      if (!quotient.breaks.defined()) quotient.breaks = at::zeros_like(num, num.options().dtype(at::kBool));
      quotient.breaks.mutable_data_ptr<bool>()[s] = true;
    }
    return value;
  };
  quotient.value = of_each_number(of_sample, num, den, v2, w2);
  return quotient;
}

}  // namespace prdp::batch_loops
