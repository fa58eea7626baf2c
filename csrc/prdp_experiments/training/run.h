#pragma once
#include <memory>
#include <string>
#include <vector>

#include "prdp/steppers/stepper.h"
#include "prdp_experiments/training/task.h"
#include "prdp_experiments/training/training.h"

namespace prdp::train {

/// One training: its intervals, their costs, and when it is lost; the same for every task.
class Run {
 public:
  /// `steppers`: of the solves of an update, one after the other.
  Run(const Scene& scene, const Refinement& refinement, int64_t seed, Checkpoint& checkpoint,
      std::vector<StepperBase*> steppers);

  Curves go(const Task& task, const OnInterval& on_interval);

 private:
  /// Of an interval; iterations and products per sample.
  struct Costs {
    int64_t max_iter;
    double rtol;
    int64_t solves = 0;
    double iterations = 0.0, forward = 0.0, adjoint = 0.0, seconds = 0.0;
    int64_t failed = 0;
  };

  void take_budget();
  double rtol() const { return steppers_[0]->options().solver.rtol; }
  int64_t done() const { return static_cast<int64_t>(curves_.seconds.size()); }
  void keep(const Task& task);
  /// Whether there is a checkpoint to go on from.
  bool restores(const Task& task);
  void run_interval(const Task& task, int64_t done);
  void append(const Costs& costs);
  void observe(const Task& task, int64_t done);
  void check(double loss, bool refused, int64_t done) const;
  /// The curves end with the interval that was lost.
  void give_up(const std::string& why);

  std::string who_;
  bool goes_on_;  // past solves that were given NaN or Inf
  int64_t intervals_;
  std::vector<StepperBase*> steppers_;
  bool watches_error_;
  std::unique_ptr<Controller> controller_;
  Checkpoint& checkpoint_;
  std::vector<Checkpoint::Found> found_;
  Curves curves_;
};

}  // namespace prdp::train
