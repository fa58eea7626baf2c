#pragma once
#include <cstdint>
#include <string>
#include <vector>

namespace prdp::train {

/// What a training leaves, one entry an interval: an epoch, or an update where there is no network. Costs are those of
/// all solves of an update, of which a corrector has two and a field one a step.
struct Curves {
  std::vector<double> update_loss;  // one entry an update
  std::vector<double> metric;       // starts before the first interval
  std::vector<double> error;        // as metric; the relative error that a user knows, which the tolerances follow
  std::vector<int64_t> max_iter;    // K
  std::vector<int64_t> budget;      // K times the solves, the paper's count
  // Per sample of a batch, summed over updates; the applications are those of both solves.
  std::vector<double> iterations, operator_applications, adjoint_applications;
  std::vector<double> rtol;  // of the forward solves
  std::vector<int64_t> failed;  // samples whose forward or adjoint solve failed, over the updates
  std::vector<double> seconds;
  std::string diverged;  // where and why a training was lost; its curves end there, with a metric of NaN
  std::string warning;   // what the controller says in the end
  std::string weights;   // in the end, of a network or θ, as pack_weights() makes them
};

/// Calls f(name, values) for each of them that has an entry for every interval or update.
template <class AnyCurves, class F>
void each_curve(AnyCurves& curves, const F& f) {
  f("update_loss", curves.update_loss);
  f("metric", curves.metric);
  f("error", curves.error);
  f("max_iter", curves.max_iter);
  f("budget", curves.budget);
  f("iterations", curves.iterations);
  f("operator_applications", curves.operator_applications);
  f("adjoint_applications", curves.adjoint_applications);
  f("rtol", curves.rtol);
  f("failed", curves.failed);
  f("seconds", curves.seconds);
}

}  // namespace prdp::train
