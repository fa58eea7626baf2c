#pragma once
#include "prdp_experiments/data/field_problem.h"
#include "prdp_experiments/training/fused_adam.h"
#include "prdp_experiments/training/task.h"

namespace prdp::train {

/// The task "field": Adam finds θ, with κ = exp(θ), from what is observed. An interval is a single update, the metric
/// the relative error of κ, and the error that a user knows the relative misfit of the observations.
class FieldTraining {
 public:
  FieldTraining(const Scene& scene, Solver solver, int64_t seed);
  FieldTraining(const FieldTraining&) = delete;

  ImplicitStep& stepper() { return model_.stepper(); }
  const at::Tensor& theta() const { return theta_; }
  /// Refers to this object.
  Task task();

 private:
  void update(int64_t number, const OnUpdate& on_update);

  const Scene& scene_;
  FieldProblem problem_;
  at::Tensor theta_;
  FieldModel model_;
  FusedAdam optimiser_;
  double misfit_ = 1.0;  // before the first solve nothing is explained yet
};

}  // namespace prdp::train
