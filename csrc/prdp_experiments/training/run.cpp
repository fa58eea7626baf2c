#include "prdp_experiments/training/run.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <limits>

#include "prdp/controller/attach.h"
#include "prdp/solvers/status.h"
#include "prdp_experiments/training/failures.h"
#include "prdp_experiments/training/progress.h"

namespace prdp::train {

namespace {

/// Of counts (batch), or (batch, steps) of a rollout, summed over the steps.
double per_sample(const at::Tensor& counts) { return counts.to(at::kDouble).mean(0).sum().item<double>(); }

/// What the trainer reads of a report, on the CPU: one copy from a device, for which the host waits.
struct Report {
  at::Tensor iterations, operator_applications, status;

  explicit Report(const SolveInfo& info)
      : iterations(info.iterations), operator_applications(info.operator_applications), status(info.status) {
    if (status.is_cpu()) return;
    const auto all = at::stack({iterations, operator_applications, status}).cpu();
    iterations = all[0];
    operator_applications = all[1];
    status = all[2];
  }
  bool refused() const { return status.le(static_cast<int64_t>(SolveStatus::kNonfiniteInput)).any().item<bool>(); }
};

struct Diverged {
  std::string why;
};

}  // namespace

Run::Run(const Scene& scene, const Refinement& refinement, int64_t seed, Checkpoint& checkpoint,
         std::vector<StepperBase*> steppers)
    : who_(scene.name + ", " + refinement.label + ", seed " + std::to_string(seed)),
      goes_on_(scene.on_failure == OnFailure::kZeroGrad),
      intervals_(scene.training.intervals),
      steppers_(std::move(steppers)),
      watches_error_(refinement.watches_error),
      controller_(refinement.controller()),
      checkpoint_(checkpoint),
      found_(checkpoint.find()) {
  if (refinement.start && !scene.physics.is_kolmogorov())  // the solves of a Flow are for changes
    for (auto* stepper : steppers_) stepper->options().start = *refinement.start;
  take_budget();
}

Curves Run::go(const Task& task, const OnInterval& on_interval) {
  const auto report = [&] { on_interval(done(), curves_.metric.back(), controller_->max_iter()); };
  try {
    restores(task) ? report() : observe(task, 0);
    while (done() < intervals_) {
      run_interval(task, done() + 1);
      observe(task, done());
      if (done() < intervals_ && checkpoint_.due()) keep(task);
      report();
    }
  } catch (const Diverged& divergence) {
    give_up(divergence.why);
  }
  return curves_;
}

void Run::take_budget() {
  for (auto* stepper : steppers_) set_budget(*stepper, controller_->budget());
}
void Run::keep(const Task& task) {
  TensorMap tensors;
  task.save(tensors);
  save(tensors, curves_, controller_->state());
  checkpoint_.write(pack(tensors));
}

bool Run::restores(const Task& task) {
  const bool there = checkpoint_.restore(found_, [&](Saved& saved) {
    auto progress = load_progress(saved, task.updates_per_interval);
    task.load(saved, static_cast<int64_t>(progress.curves.update_loss.size()));
    controller_->load_state(std::move(progress.controller));
    curves_ = std::move(progress.curves);
  });
  if (!checkpoint_.notice().empty()) std::fprintf(stderr, "prdp_train: warning: %s\n", checkpoint_.notice().c_str());
  if (!there) return false;
  checkpoint_.check_length(done(), intervals_);
  take_budget();
  return true;
}

void Run::run_interval(const Task& task, int64_t done) {
  Costs costs{.max_iter = controller_->max_iter(), .rtol = rtol()};
  const auto started = std::chrono::steady_clock::now();
  Failures failures;
  task.updates(static_cast<int64_t>(curves_.update_loss.size()), [&](double loss, const auto& samples) {
    std::vector<at::Tensor> forward, backward;
    bool refused = false;
    for (const auto* stepper : steppers_) {
      const Report report(*stepper->info());
      refused = refused || report.refused();
      forward.push_back(report.status);
      costs.solves += report.iterations.numel() / report.iterations.size(0);
      costs.iterations += per_sample(report.iterations);
      costs.forward += per_sample(report.operator_applications);
      if (const auto info = stepper->adjoint_info()) {
        const Report adjoint(*info);
        backward.push_back(adjoint.status);
        costs.adjoint += per_sample(adjoint.operator_applications);
      }
    }
    check(loss, refused, done);
    curves_.update_loss.push_back(loss);
    failures.take(forward, backward, samples);
  });
  costs.failed = failures.count();
  if (costs.failed > 0) std::fprintf(stderr, "prdp_train: %s, %s\n", who_.c_str(), failures.line(done).c_str());
  const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - started;
  costs.seconds = elapsed.count();
  append(costs);
}

void Run::append(const Costs& costs) {
  curves_.max_iter.push_back(costs.max_iter);
  curves_.budget.push_back(costs.max_iter * costs.solves);
  curves_.iterations.push_back(costs.iterations);
  curves_.operator_applications.push_back(costs.forward + costs.adjoint);
  curves_.adjoint_applications.push_back(costs.adjoint);
  curves_.rtol.push_back(costs.rtol);
  curves_.failed.push_back(costs.failed);
  curves_.seconds.push_back(costs.seconds);
}

void Run::observe(const Task& task, int64_t done) {
  const double metric = task.metric();
  const auto interval = "interval " + std::to_string(done);
  if (!std::isfinite(metric)) throw Diverged{interval + ": the metric is " + std::to_string(metric)};
  curves_.metric.push_back(metric);
  auto solves = last_solves({steppers_.begin(), steppers_.end()});
  solves.error = task.error(metric);
  if (!std::isfinite(*solves.error))
    throw Diverged{interval + ": the relative error is " + std::to_string(*solves.error)};
  curves_.error.push_back(*solves.error);
  controller_->step(watches_error_ ? *solves.error : metric, solves);
  curves_.warning = controller_->warning().value_or("");
  take_budget();
}

void Run::check(double loss, bool refused, int64_t done) const {
  const auto interval = "interval " + std::to_string(done);
  if (!std::isfinite(loss)) throw Diverged{interval + ": the loss is " + std::to_string(loss)};
  if (refused && !goes_on_) throw Diverged{interval + ": the solver was given NaN or Inf"};
}

void Run::give_up(const std::string& why) {
  curves_.diverged = why;
  curves_.warning.clear();
  const auto lost = std::max<size_t>(1, curves_.metric.size());
  curves_.metric.resize(lost + 1, std::numeric_limits<double>::quiet_NaN());
  curves_.error.resize(lost + 1, std::numeric_limits<double>::quiet_NaN());
  if (curves_.seconds.size() < lost) append({.max_iter = controller_->max_iter(), .rtol = rtol()});
}

}  // namespace prdp::train
