#pragma once
#include <ATen/ATen.h>

#include <functional>

#include "prdp_experiments/scenes/scene.h"

namespace prdp {

/// Random truncated Fourier series (paper, appendix E): for n = 1 … modes, every product of sin(2πn·) and cos(2πn·)
/// over the axes, in units of their lengths, with amplitudes uniform in (-1, 1). Returns their values at the unknowns,
/// (samples, channels, *shape). The same seed gives the same series in Python and C++.
at::Tensor fourier_series(const Scene::Physics& physics, int64_t samples, int64_t modes, int64_t seed,
                          at::ScalarType dtype);

/// Raises RuntimeError if the last solve of the reference solver did not converge.
void check_converged(const StepperBase& reference);
/// One step of the reference solver, checked.
template <class Step>
at::Tensor converged_step(Step& reference, const at::Tensor& u) {
  auto next = reference(u);
  check_converged(reference);
  return next;
}

/// Where the data of a scene are made: on the CPU; but those of "kolmogorov", whose reference flow is large, on its
/// device, where they are the same to the tolerance of their solves.
at::Device device_of_data(const Scene& scene);

/// Called while data are made, with the number of steps done and of all steps. Steps are counted per sample.
using OnProgress = std::function<void(int64_t, int64_t)>;

/// The samples of a scene: initial states, and the states after converged steps from them, each
/// (samples, channels, *shape). Training samples make data.trained_steps, validation samples data.valid_steps. Of
/// "darcy" the states are pressures and log κ in turn.
struct Dataset {
  at::Tensor train_start, train_end, valid_start, valid_end;
  at::Tensor train_between;  // (samples, trained_steps - 1, channels, *shape); only for the task "corrector"
};
/// Makes the samples of a scene, and moves them to its device. Flows in two dimensions take seconds to minutes, because
/// their reference solves are iterative. Their data are kept on disk (data_cache.h).
Dataset make_dataset(const Scene& scene, const OnProgress& on_progress = {});
/// The same on a device.
Dataset moved(Dataset data, const at::Device& device);
/// Those of make_dataset() as tensors of the CPU, without the cache on disk.
Dataset compute_dataset(const Scene& scene, const OnProgress& on_progress = {});

/// The training samples alone, in the train_ fields.
Dataset compute_training_samples(const Scene& scene, const OnProgress& on_progress = {});

/// The trajectories of the validation samples: `steps` converged steps, (samples, steps + 1, channels, *shape). Their
/// state number data.valid_steps is the valid_end of make_dataset(). Raises ValueError for steps < 0, and for a task
/// that trains no network and so has no samples.
at::Tensor validation_trajectories(const Scene& scene, int64_t steps, const OnProgress& on_progress = {});
/// The same for all samples, the training samples first.
at::Tensor all_trajectories(const Scene& scene, int64_t steps, const OnProgress& on_progress = {});

/// The problem of the task "parameters": find the amplitudes θ of the load p(x) = Σ_i θ_i sin(2πi x/L).
struct ParameterProblem {
  at::Tensor modes;      // (P, N): the sines at the unknowns
  at::Tensor start;      // (P,): θ at the beginning
  at::Tensor reference;  // (P,): θ to be found
  at::Tensor solution;   // (1, 1, N): the exact u for the reference
};
ParameterProblem make_parameter_problem(const Scene& scene);

/// The order in which an epoch goes through the samples: a random permutation of 0 … samples - 1.
at::Tensor shuffled(int64_t samples, at::Generator& generator);
at::Generator make_generator(int64_t seed);

}  // namespace prdp
