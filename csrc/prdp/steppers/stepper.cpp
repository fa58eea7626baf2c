#include "prdp/steppers/stepper.h"

#include "prdp/autograd/adjoint_log.h"
#include "prdp/solvers/status.h"
#include "prdp/steppers/idle_steps.h"
#include "prdp/steppers/rollout_loops.h"

namespace prdp {

AdjointLog open_adjoint_log() {
  return {new int64_t(adjoint_log::open()), [](const int64_t* log) {
            adjoint_log::close(*log);
            delete log;
          }};
}

std::optional<SolveInfo> join_adjoint_logs(at::IntArrayRef logs) {
  std::vector<std::optional<SolveInfo>> found;
  const SolveInfo* any = nullptr;
  for (const int64_t log : logs) found.push_back(adjoint_log::read(log));
  for (const auto& info : found)
    if (info) any = &*info;
  if (!any) return std::nullopt;
  const SolveInfo none{at::zeros_like(any->iterations), at::zeros_like(any->residual),
                       at::full_like(any->status, static_cast<int64_t>(SolveStatus::kConverged)),
                       at::zeros_like(any->operator_applications), at::zeros_like(any->floor)};
  std::vector<SolveInfo> infos;
  for (const auto& info : found) infos.push_back(info.value_or(none));
  return side_by_side(std::move(infos), any->residual);
}

StepperBase::StepperBase(std::string who, SolveOptions options)
    : who_(std::move(who)), options_(std::move(options)), log_(open_adjoint_log()) {
  options_.check(who_.c_str());
}

void StepperBase::check_state(const at::Tensor& u) const {
  TORCH_CHECK_VALUE(log_, "a stepper that was moved from makes no steps");
  TORCH_CHECK_VALUE(u.defined(), who_, ": u is an undefined tensor");
  TORCH_CHECK_VALUE(u.layout() == at::kStrided, who_, ": u must be a dense tensor, got the layout ", u.layout());
}

void StepperBase::keep(SolveInfo info) {
  warn_of_idle_steps(info, options_.solver.rtol, has_controller_, options_.on_failure);
  info_ = std::move(info);
}

void StepperBase::set_max_iter(int64_t k) {
  auto solver = options_.solver;
  solver.max_iter = k;
  solver.check(who_.c_str());
  options_.solver = std::move(solver);
}

std::optional<SolveInfo> StepperBase::adjoint_info() const {
  if (!log_) return std::nullopt;  // moved from
  if (logs_of_steps_.empty()) return adjoint_log::read(*log_);
  std::vector<int64_t> numbers;
  for (const auto& log : logs_of_steps_) numbers.push_back(*log);
  return join_adjoint_logs(numbers);
}

bool StepperBase::converged() const {
  const auto adjoint = adjoint_info();
  return info_ && info_->solved().all().item<bool>() && (!adjoint || adjoint->solved().all().item<bool>());
}

}  // namespace prdp
