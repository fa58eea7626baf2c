#include "prdp/solvers/tensor_preconditioner.h"

#include <ATen/core/grad_mode.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>

#include <limits>
#include <memory>

#include "prdp/error_text.h"
#include "prdp/kernels/kernel.h"
#include "prdp/kernels/preconditioner.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/registered_products.h"
#include "prdp/solvers/solve_on_gpu.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

/// M⁻¹ v, or M⁻ᵀ v, of every sample of a batch.
class Inverse : public torch::CustomClassHolder {
 public:
  virtual at::Tensor apply(const at::Tensor& v, bool transposed) = 0;
};

class CyclesOnGpu final : public Inverse {
 public:
  CyclesOnGpu(gpu::Product product, gpu::Product transpose)
      : product_(std::move(product)), transpose_(std::move(transpose)) {}
  at::Tensor apply(const at::Tensor& v, bool transposed) override { return (transposed ? transpose_ : product_)(v); }

 private:
  gpu::Product product_, transpose_;
};

/// On the CPU; vectors of other devices are copied there and back.
template <class T>
class CyclesOnLoops final : public Inverse {
 public:
  CyclesOnLoops(std::shared_ptr<const kernels::Kernels> a, std::shared_ptr<const kernels::Kernels> transpose,
                int64_t smoothing, int64_t batch)
      : memory_of_a_(std::move(a)), memory_of_transpose_(std::move(transpose)) {
    const auto& kernels = std::get<kernels::KernelBatch<T>>(memory_of_a_->of_dtype);
    const auto& transposes = std::get<kernels::KernelBatch<T>>(memory_of_transpose_->of_dtype);
    for (int64_t s = 0; s < (kernels.is_shared ? 1 : batch); ++s) {
      auto& sample = samples_.emplace_back();
      sample.a = kernels.make(s);
      sample.transpose = transposes.make(s);
      if (sample.a && sample.transpose) sample.inverse = sample.a->multigrid(sample.transpose.get(), smoothing);
    }
  }

  at::Tensor apply(const at::Tensor& v, bool transposed) override {
    const auto from = v.to(at::kCPU).contiguous();
    const auto out = at::full_like(from, std::numeric_limits<double>::quiet_NaN());
    const int64_t unknowns = from.numel() / std::max<int64_t>(from.size(0), 1);
    for (int64_t s = 0; s < from.size(0); ++s) {
      auto& sample = samples_.size() == 1 ? samples_[0] : samples_[s];
      if (!sample.inverse) continue;
      const auto& layout = sample.a->layout();
      workspace_.prepare(2, sample.a->length(), layout.halo);
      T *r = workspace_.vector(0), *z = workspace_.vector(1);
      layout.load(from.const_data_ptr<T>() + s * unknowns, T(1), r);
      if (transposed) sample.inverse->apply_transpose(r, z);
      else sample.inverse->apply(r, z);
      layout.store(z, sample.a->factor(), out.mutable_data_ptr<T>() + s * unknowns);
    }
    return out.to(v.device());
  }

 private:
  struct Sample {
    std::unique_ptr<kernels::Kernel<T>> a, transpose;
    std::unique_ptr<kernels::Preconditioner<T>> inverse;  // null where A is not finite, or a diagonal is zero
  };

  std::shared_ptr<const kernels::Kernels> memory_of_a_, memory_of_transpose_;
  std::vector<Sample> samples_;
  kernels::Workspace<T> workspace_;
};

/// It is linear in v, so its derivative is the transpose.
class ApplyInverse : public torch::autograd::Function<ApplyInverse> {
 public:
  static at::Tensor forward(AutogradContext* ctx, const at::Tensor& v, const c10::intrusive_ptr<Inverse>& inverse,
                            bool transposed) {
    ctx->saved_data["inverse"] = c10::IValue::make_capsule(inverse);
    ctx->saved_data["transposed"] = transposed;
    return inverse->apply(v.detach(), transposed);
  }
  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto inverse = c10::static_intrusive_pointer_cast<Inverse>(ctx->saved_data["inverse"].toCapsule());
    return {ApplyInverse::apply(grads[0], inverse, !ctx->saved_data["transposed"].toBool()), {}, {}};
  }
};

c10::intrusive_ptr<Inverse> make_cycles(const Operator& a, const Preconditioner& m, const at::Tensor& b) {
  if (auto product = gpu::make_cycle(a, /*transposed=*/false, m, b))
    if (auto transpose = gpu::make_cycle(a, /*transposed=*/true, m, b))
      return c10::make_intrusive<CyclesOnGpu>(std::move(product), std::move(transpose));
  auto kernels = a.kernels(b, false), transpose = a.kernels(b, true);
  if (b.scalar_type() == at::kFloat)
    return c10::make_intrusive<CyclesOnLoops<float>>(std::move(kernels), std::move(transpose), m.smoothing(),
                                                     b.size(0));
  return c10::make_intrusive<CyclesOnLoops<double>>(std::move(kernels), std::move(transpose), m.smoothing(), b.size(0));
}

/// What an operator refuses, said of the preconditioner.
template <typename Call>
auto in_its_name(const Call& call) {
  try {
    return call();
  } catch (const c10::TypeError& error) {
    TORCH_CHECK_TYPE(false, "preconditioner: ", error.what_without_backtrace());
  } catch (const c10::ValueError& error) {
    TORCH_CHECK_VALUE(false, "preconditioner: ", error.what_without_backtrace());
  }
}

/// A function of the user's own with a transpose: neither needs to be made of operations that autograd sees.
class OwnInverse final : public Inverse {
 public:
  explicit OwnInverse(std::shared_ptr<Operator> of) : of_(std::move(of)) {}
  at::Tensor apply(const at::Tensor& v, bool transposed) override {
    return in_its_name([&] { return transposed ? of_->apply_transpose(v) : of_->apply(v); });
  }

 private:
  std::shared_ptr<Operator> of_;
};

}  // namespace

TensorPreconditioner make_inverse(const Operator& a, const Preconditioner& preconditioner, const at::Tensor& b) {
  if (preconditioner.is_operator()) {
    const std::shared_ptr<Operator> inverse = make_operator(preconditioner.spec());
    in_its_name([&] { inverse->check_vector(b); });
    const auto products = products_of(preconditioner.spec());
    const auto own = products && products->products().apply_transpose ? c10::make_intrusive<OwnInverse>(inverse)
                                                                      : c10::intrusive_ptr<OwnInverse>();
    const bool is_own = products != nullptr;
    return [inverse, own, is_own](const at::Tensor& v) {
      const bool recorded = at::GradMode::is_enabled() && v.requires_grad();
      if (own && recorded && !in_torch_func() && !has_tangent(v)) return ApplyInverse::apply(v, own, false);
      const auto found = in_its_name([&] { return inverse->apply(v); });
      TORCH_CHECK_VALUE(!recorded || !is_own || found.requires_grad(),
                        "preconditioner: autograd does not see how its product depends on the vector, as after ",
                        in_language("detach() or numpy()", "detach()"),
                        ", and unrolled mode differentiates it; give its transpose, or say that it is symmetric");
      return found;
    };
  }
  if (!preconditioner.is_multigrid()) return {};
  return [cycles = make_cycles(a, preconditioner, b.detach())](const at::Tensor& v) {
    return ApplyInverse::apply(v, cycles, /*transposed=*/false);
  };
}

}  // namespace prdp
