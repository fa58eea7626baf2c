#pragma once
#include <concepts>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <vector>

namespace prdp {

/// Below it, solves are as good as converged.
inline constexpr double kSmallResidual = 1e-4;

/// The outcome of the solves of an interval, and the error of what is trained.
struct Solves {
  bool converged = false;            // whether all of them met their tolerance
  std::optional<double> residual{};  // ‖b - A u‖ / ‖b‖ at their end, the mean over the samples that did not fail
  /// The relative error of what is trained. For a network, ‖u - u_ref‖ / ‖u_ref‖ after one step: the square root of a
  /// normalised squared metric, divided by the number of steps. In an inverse problem, the relative misfit.
  std::optional<double> error{};
  /// The share of samples whose solve took no iteration, as its start met the tolerance, and is above rounding.
  double idle = 0.0;
  /// The share of samples that failed.
  double failed = 0.0;

  Solves() = default;
  /// From a bool alone: an error or a residual in its place would pass for true.
  Solves(std::same_as<bool> auto all_converged, std::optional<double> mean_residual = {},
         std::optional<double> relative_error = {})
      : converged(all_converged), residual(mean_residual), error(relative_error) {}
};

/// Limits of the solves of the next interval. A stepper keeps its own value where none is given.
struct Budget {
  int64_t max_iter;  // K
  std::optional<int64_t> adjoint_max_iter{};
  std::optional<double> rtol{}, adjoint_rtol{};
};

/// Chooses K or the tolerance of the solves after each training interval. An interval is an epoch, for example.
class Controller {
 public:
  /// One call of step().
  struct Record {
    double metric;
    double smoothed;  // L̃, the exponential mean with this metric; of a ToleranceController the smallest error so far
    int64_t max_iter;  // K before the decision
    bool refined;
    std::optional<double> error{}, residual{};  // as in Solves
  };
  /// All that step() depends on beside the settings. A LinearSchedule keeps only K and the last record.
  struct State {
    int64_t max_iter;
    /// c, L̃ at the last refinement; of a ToleranceController the smallest error so far.
    double checkpoint = std::numeric_limits<double>::infinity();
    std::vector<Record> history{};
  };

  virtual ~Controller() = default;
  /// K for the next interval.
  int64_t max_iter() const { return state_.max_iter; }
  /// All limits for the next interval, K included.
  virtual Budget budget() const = 0;
  /// Call this after each interval, and once before the first. A smaller metric is better. Returns true if the solves
  /// were refined. Raises ValueError, and changes nothing, for a negative or non-finite metric; a schedule ignores it.
  virtual bool step(double metric, const Solves& solves = {}) = 0;
  const State& state() const { return state_; }
  /// Restores a state. Raises ValueError, and changes nothing, for a state of numbers that no controller has.
  virtual void load_state(State state) = 0;

  /// What is wrong, or nothing: a sentence about the metric, one about the solves, or both.
  ///   - The last step() raised an error for its metric; or else the metric grows: it was more than twice its least
  ///     value, three times in a row.
  ///   - The solves stop so far from the solution that their error dominates what is trained. The reason: say the
  ///     network gives v, and training makes the solve P_K v meet u₂ = P v_ref. If the loss is small, v - v_ref is the
  ///     residual of that solve. So a residual as large as the error is the error. If the error is not known, a large
  ///     residual counts once the metric has stalled.
  ///   - Most of the last solves took no iteration, so that steps pass their start on, or failed.
  std::optional<std::string> warning() const;

 protected:
  explicit Controller(int64_t max_iter) : state_{max_iter} {}
  /// Raises ValueError unless the metric is finite and >= 0. warning() then reports it.
  void check_metric(double metric);
  /// Raises ValueError unless the error and the residual, where they are known, are finite and >= 0. warning() then
  /// reports solves that did nothing, or failed.
  void check_solves(const Solves& solves);
  /// Raises ValueError for a state that no controller can have reached; a metric that `is_ignored` may be anything.
  void check_state(const State& state, bool is_ignored = false) const;
  virtual const char* name() const = 0;
  /// What messages call the metric.
  virtual const char* metric_name() const { return "metric"; }
  /// Whether the metric is relative to the size of what is trained for.
  virtual bool has_relative_metric() const { return false; }
  /// What the user should do about the warning, as the end of a sentence.
  virtual const char* remedy() const = 0;
  /// Whether the metric no longer falls.
  virtual bool stalled() const = 0;
  /// The residual that the solves before the last step() were asked for, which is no cause for a warning.
  virtual double asked_for() const { return 0.0; }

  State state_;

 private:
  std::string about_metric() const;
  std::string about_residual() const;

  std::optional<double> refused_;  // the metric of the last step(), if it raised an error
  double idle_ = 0.0, failed_ = 0.0;  // of its solves
};

/// ⌈ratio · K⌉, the iterations of an adjoint solve: at least one where K is. Raises ValueError in the name of `who`
/// unless 0 < ratio <= 1.
int64_t adjoint_share(const char* who, double ratio, int64_t max_iter);

}  // namespace prdp
