#pragma once
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <vector>

namespace prdp {

/// What the solves of an interval were like, and what they were good for.
struct Solves {
  bool converged = false;            // all of them met their tolerance
  std::optional<double> residual{};  // ‖b - A u‖ / ‖b‖ where they ended, mean over the samples
  /// ‖u - u_ref‖ / ‖u_ref‖ of what is trained, after one step: the square root of a normalised squared
  /// metric over the steps that it follows, or the relative misfit of an inverse problem.
  std::optional<double> error{};

  Solves(bool converged = false, std::optional<double> residual = {}, std::optional<double> error = {})
      : converged(converged), residual(residual), error(error) {}
};

/// What the solves of the coming interval get. What is not given stays as the stepper has it.
struct Budget {
  int64_t max_iter;  // K
  std::optional<int64_t> adjoint_max_iter{};
  std::optional<double> rtol{}, adjoint_rtol{};
};

/// Decides how far the solver goes, from one training interval to the next.
class Controller {
 public:
  /// What was decided at one call of step().
  struct Record {
    double metric;
    double smoothed;   // L̃ with this metric; of a ToleranceController the smallest error so far
    int64_t max_iter;  // K before the decision
    bool refined;
    std::optional<double> error{}, residual{};  // as in Solves
  };
  /// All that step() depends on beside the settings; of a schedule K and the last record alone.
  struct State {
    int64_t max_iter;
    /// c, L̃ at the last refinement; of a ToleranceController the smallest error so far.
    double checkpoint = std::numeric_limits<double>::infinity();
    std::vector<Record> history{};
  };

  virtual ~Controller() = default;
  /// K for the coming interval.
  virtual int64_t max_iter() const = 0;
  /// All that the coming interval's solves get, K among it.
  virtual Budget budget() const = 0;
  /// Called after each interval (and once before the first) with the metric to watch, smaller being
  /// better. True if the solves were refined.
  virtual bool step(double metric, const Solves& solves = {}) = 0;
  virtual const State& state() const = 0;
  /// Raises ValueError, and changes nothing, for a state that these settings cannot have reached.
  virtual void load_state(State state) = 0;

  /// In words, what is wrong if the training ends here: solves that stop so far from the solution that
  /// their own error makes up what is learnt. Nothing where all is well or the residual is not known.
  /// Where the network gives v, the solve P_K v is trained to meet u₂ = P v_ref, and the loss is small, then
  /// v - v_ref is the residual of that solve: a residual as large as the error is the error. Where no error
  /// is known, a large residual counts once the metric has stalled.
  /// Before that: a metric that step() has just refused, and one that grows, which more than doubles its least value
  /// three times in a row.
  std::optional<std::string> warning() const;

 protected:
  /// Raises ValueError unless the metric (`what`) is finite and >= 0, and remembers it for warning().
  void check_metric(double metric, const char* what);
  virtual const char* name() const = 0;
  /// What to do about the warning, as the end of a sentence.
  virtual const char* remedy() const = 0;
  /// Whether the metric no longer falls.
  virtual bool stalled() const = 0;

 private:
  std::string about_metric() const;
  std::string about_residual() const;

  std::optional<double> refused_;  // the metric of the last step(), if it was no number to go by
};

/// ⌈ratio · K⌉, what an adjoint solve gets of K. Raises ValueError unless 0 < ratio <= 1.
int64_t adjoint_share(const char* who, double ratio, int64_t max_iter);

}  // namespace prdp
