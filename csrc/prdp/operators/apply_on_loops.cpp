#include "prdp/operators/apply_on_loops.h"

#include <limits>

#include "prdp/kernels/kernel.h"
#include "prdp/threads/share_samples.h"

namespace prdp {

namespace {

/// Whether no number near the ends of the range of T can have taken part in a product with these largest numbers.
template <class T>
bool is_ordinary(T largest) {
  return std::isfinite(largest) && largest >= std::numeric_limits<T>::min() / std::numeric_limits<T>::epsilon();
}

template <class T>
void apply_to_samples(const kernels::KernelBatch<T>& kernels, const at::Tensor& v, const at::Tensor& out) {
  const int64_t unknowns = v.numel() / v.size(0);
  const auto shared = kernels.is_shared && !kernels.product ? kernels.make(0) : nullptr;
  constexpr int64_t worthwhile = 1 << 15;  // unknowns for a thread
  share_samples(v.size(0), unknowns, std::max<int64_t>(1, worthwhile / unknowns), [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) {
      const T* from = v.const_data_ptr<T>() + s * unknowns;
      T* to = out.mutable_data_ptr<T>() + s * unknowns;
      if (kernels.product) {
        kernels.product(s, from, to);
        if (is_ordinary(kernels::largest_magnitude(to, unknowns))) continue;
      }
      const auto own = shared ? nullptr : kernels.make(kernels.is_shared ? 0 : s);
      const auto* a = shared ? shared.get() : own.get();
      if (!a) {
        std::fill_n(to, unknowns, std::numeric_limits<T>::quiet_NaN());
        continue;
      }
      kernels::Workspace<T> memory;
      memory.prepare(2, a->length(), a->layout().halo);
      a->layout().load(from, T(1), memory.vector(0));
      a->apply(memory.vector(0), memory.vector(1));
      a->layout().store(memory.vector(1), T(1) / a->factor(), to);
    }
  });
}

}  // namespace

at::Tensor apply_on_loops(const Operator& a, const at::Tensor& v, bool transposed) {
  const auto kernels = v.is_cpu() && v.numel() > 0 ? a.kernels(v, transposed) : nullptr;
  if (!kernels) return transposed ? a.apply_transpose(v) : a.apply(v);
  const auto from = v.detach().contiguous();
  const auto out = at::empty_like(from);
  std::visit([&](const auto& batch) { apply_to_samples(batch, from, out); }, kernels->of_dtype);
  return out;
}

}  // namespace prdp
