#pragma once
#include <ATen/ATen.h>

#include <functional>

#include "prdp/scenes/scene.h"

namespace prdp {

/// Random truncated Fourier series (paper, appendix E): for n = 1 … modes, every product of
/// sin(2πn·) and cos(2πn·) over the axes, amplitudes U(-1, 1). Shape (samples, channels, *shape), values
/// at the grid's unknowns; the same seed gives the same series in every language.
at::Tensor fourier_series(const Scene::Physics& physics, int64_t samples, int64_t modes, int64_t seed,
                          at::ScalarType dtype);

/// reference(u); raises RuntimeError where the solve does not converge.
at::Tensor converged_step(Stepper& reference, const at::Tensor& u);

/// Called while data are made with (steps of a sample done, all of them).
using OnProgress = std::function<void(int64_t, int64_t)>;

/// Initial states and where steps of the converged equation take them, two of them in training and
/// data.valid_steps in validation; each (samples, channels, *shape).
struct Dataset {
  at::Tensor train_start, train_end, valid_start, valid_end;
  at::Tensor train_first;  // after one step; of the task "corrector" alone
};
/// The data of flows in the plane, whose reference solves are iterative, take seconds to minutes: they are kept on
/// disk (data_cache.h).
Dataset make_dataset(const Scene& scene, const OnProgress& on_progress = {});
/// The same without the file on disk.
Dataset compute_dataset(const Scene& scene, const OnProgress& on_progress = {});

/// The training samples alone, in the train_ fields.
Dataset compute_training_samples(const Scene& scene, const OnProgress& on_progress = {});

/// The validation samples and the states of `steps` steps of the converged equation from them, in all
/// (samples, steps + 1, channels, *shape): at step data.valid_steps what `make_dataset` gives, and as far
/// beyond as wanted. Raises ValueError for a task that trains no network, which has no samples, and for steps < 0.
at::Tensor validation_trajectories(const Scene& scene, int64_t steps, const OnProgress& on_progress = {});
/// The same of all samples, the training's first.
at::Tensor all_trajectories(const Scene& scene, int64_t steps, const OnProgress& on_progress = {});

/// What the task "parameters" is about: p(x) = Σ_i θ_i sin(2πi x).
struct ParameterProblem {
  at::Tensor modes;      // (P, N): the sines at the unknowns
  at::Tensor start;      // (P,): θ to begin with
  at::Tensor reference;  // (P,): θ to be found
  at::Tensor solution;   // (1, 1, N): the exact u of the reference
};
ParameterProblem make_parameter_problem(const Scene& scene);

/// The order in which an epoch goes through `samples`, from a generator seeded once per training.
at::Tensor shuffled(int64_t samples, at::Generator& generator);
at::Generator make_generator(int64_t seed);

}  // namespace prdp
