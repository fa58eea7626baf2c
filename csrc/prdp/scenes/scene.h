#pragma once
#include <optional>
#include <string>
#include <vector>

#include "prdp/controller/prdp_controller.h"
#include "prdp/solvers/solver.h"
#include "prdp/steppers/stepper.h"

namespace prdp {

/// The most seeds, intervals and iterations of a solve that a scene or a command may ask for: products of them count
/// the costs.
inline constexpr int64_t kMostCounted = 1'000'000'000;

/// A training experiment as data: what a scene file says. One reader serves both languages.
struct Scene {
  enum class Task {
    kEmulator,    // a network learns one step of the equation (paper, section 4.2)
    kCorrector,   // a network corrects the steps of a coarse flow (appendix E)
    kParameters,  // amplitudes of the right-hand side are found from the solution (section 4.1)
    kField,       // a diffusivity field is found from snapshots of states (field_problem.h); not in the paper
  };
  struct Physics {
    std::string equation;
    std::vector<int64_t> shape;
    double nu = 0.0, dt = 0.0;  // neither of poisson; diffusion has no nu

    bool periodic() const {
      return equation == "burgers" || equation == "navier_stokes" || equation == "diffusion";
    }
    /// Of a state (batch, channels, *shape): a velocity has a component for each axis, a flow a pressure too.
    int64_t channels() const {
      if (equation == "navier_stokes") return 3;
      return equation == "burgers" ? static_cast<int64_t>(shape.size()) : 1;
    }
    /// Whether an exact solve costs about what an iterative one does: not that of a periodic grid in the plane,
    /// whose sparse LU takes tens of times as long.
    bool direct_is_cheap() const { return !(periodic() && shape.size() > 1); }
  };
  struct Data {
    int64_t modes = 0, train = 0, valid = 0, seed = 0;
    int64_t valid_steps = 0;  // how far the metric follows the validation samples
    // Of a corrector: the grid of the reference, which it never sees, and the converged K of the metric.
    std::vector<int64_t> reference_shape{};
    int64_t valid_max_iter = 0;
    // HDF5 file of trajectories in place of random initial states, relative to the folder of the scene's file; empty:
    // none. Only the Python trainer reads it.
    std::string file{};
  };
  struct Network {
    std::string kind;             // "mlp" or "resnet"
    std::vector<int64_t> hidden;  // mlp
    int64_t blocks = 0, width = 0;  // resnet
    bool zero_output = false;       // the last layer starts at zero
  };
  struct Training {
    std::string loss;  // "nmse" or "mse"
    double learning_rate = 0.0;
    double decay = 1.0;  // of the learning rate, over decay_steps updates, exponentially
    int64_t decay_steps = 1;
    std::optional<int64_t> cosine_updates;  // in place of decay: down to a tenth, over so many updates
    int64_t batch = 0;      // of a network
    int64_t intervals = 0;  // epochs of a network, else updates: what the controller counts in
  };
  struct Parameters {
    std::vector<double> start, reference;
  };
  struct Field {
    // κ = mean·exp(contrast·g), with g a random Fourier series of so many modes, scaled to max |g| = 1.
    double mean = 0.0, contrast = 0.0;
    int64_t modes = 0;
    int64_t states = 0, state_modes = 0;  // the initial states, random Fourier series too
    int64_t steps = 0, every = 0;         // how far they are followed, and how many steps apart the snapshots are
    double noise = 0.0;                   // its standard deviation over the snapshots' root mean square
    double smoothing = 0.0;               // the weight of the mean |∇θ|² in the loss
    int64_t seed = 0;
  };
  struct Compare {
    int64_t seeds = 1;
    std::vector<int64_t> constant;       // the sweep of constant K
    std::optional<double> growth;        // PRDP with K ← growth·K, as a row of its own
    std::optional<double> rtol;          // the converged K with this looser tolerance, as a row of its own
    std::vector<int64_t> schedule;       // manual schedule: start, step per interval; empty: none
    std::optional<double> target;        // iterations are counted until the metric gets there
  };

  std::string name, path, text;  // text: the file as it was read
  std::string title;
  Task task = Task::kEmulator;
  at::ScalarType dtype = at::kFloat;
  Physics physics;
  Solver solver{Method::kJacobi, 1};  // converged: max_iter is K_ε
  Backward backward = Backward::kImplicit;
  OnFailure on_failure = OnFailure::kReturn;  // or kZeroGrad: a failed sample does not stop a training
  Start start = Start::kZero;
  Data data;
  Network network;
  Training training;
  Parameters parameters;
  Field field;
  PRDPSettings prdp;
  Compare compare;

  bool trains_network() const { return task == Task::kEmulator || task == Task::kCorrector; }
  /// How many steppers an update has, one after the other; K is the budget of each of their solves.
  int64_t executions() const { return task == Task::kCorrector ? 2 : 1; }
  /// The converged solver of data and references: exact where that is cheap, else iterated until its error is
  /// below float32's rounding.
  Solver reference_solver() const;
  /// The options of the scene's solves, with this solver.
  SolveOptions options(Solver solver) const;
  /// The scene's step with this solver; not of the task "field", whose equation changes from update to update.
  Stepper stepper(Solver solver) const;
  /// Replaces the scene's derivative. Raises ValueError for an unknown name, or one that would leave
  /// the task without a gradient.
  void set_backward(const std::string& name);
  /// The learning rate of an update, counted from 0.
  double learning_rate(int64_t update) const;
};

/// A key of a scene file, as the documentation lists it.
struct SceneKey {
  std::string table;                     // "physics"; empty at the top level
  std::string name;                      // "nu"
  std::string value;                     // "number >= 0"
  std::string unit;                      // "length²/time"; empty: none
  std::optional<std::string> otherwise;  // the default; nullopt: the key must be given where it applies
  std::string when;                      // "not for `poisson`"; empty: always
  std::string means;                     // "viscosity or diffusivity"
};
/// Every key that a scene may have, in the order in which they are read.
std::vector<SceneKey> scene_keys();

/// Reads a scene file. Raises ValueError naming file, line and what is allowed.
Scene read_scene(const std::string& path);
/// The same for a text, such as the one that a record holds. `path` stands for the file in errors and gives the name.
Scene parse_scene(const std::string& text, const std::string& path);

}  // namespace prdp
