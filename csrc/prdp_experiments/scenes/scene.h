#pragma once
#include <optional>
#include <string>
#include <vector>

#include "prdp/controller/prdp_controller.h"
#include "prdp/solvers/solver.h"
#include "prdp/steppers/steppers.h"
#include "prdp_experiments/files/count_limit.h"

namespace prdp {

/// A training experiment: the content of a scene file. Python and C++ share this reader.
struct Scene {
  enum class Task {
    kEmulator,    // a network learns one step of the equation (paper, section 4.2)
    kCorrector,   // a network corrects the steps of a coarse flow (appendix E)
    kParameters,  // find amplitudes of the right-hand side from the solution (section 4.1)
    kField,       // find a diffusivity field from snapshots of states (field_problem.h); not in the paper
  };
  struct Physics {
    std::string equation;
    std::vector<int64_t> shape;
    double nu = 0.0, dt = 0.0;  // length²/time, time; poisson and darcy have neither, diffusion no nu
    double amplitude = 0.0;  // of the force of kolmogorov, length/time²
    int64_t waves = 0;       // of it along y
    std::vector<double> lengths{};  // the sides of the domain, as a Grid takes them: empty where all are 1

    bool periodic() const;  // of the grid
    /// -∇·(κ ∇p) = f on the cells of a box, p = 0 on its sides: no time, and no unknowns on a boundary's neighbours.
    bool is_darcy() const { return equation == "darcy"; }
    /// A flow of two velocities that a wave of force drives: the steps of prdp::Flow.
    bool is_kolmogorov() const { return equation == "kolmogorov"; }
    /// The side of the domain along an axis of `shape`.
    double length(int64_t axis) const { return lengths.empty() ? 1.0 : lengths[axis]; }
    /// Of a state (batch, channels, *shape): a velocity has one for each axis, a flow the pressure too.
    int64_t channels() const;
    /// Whether an exact solve costs about as much as an iterative one. On periodic grids of two and more dimensions it
    /// does not: their sparse LU takes tens of times as long.
    bool direct_is_cheap() const { return !(periodic() && shape.size() > 1); }
  };
  struct Data {
    int64_t modes = 0, train = 0, valid = 0, seed = 0;
    int64_t valid_steps = 1;  // validation horizon in time steps
    // For a corrector: the grid of the reference solution, and the K of the converged solves behind the metric.
    std::vector<int64_t> reference_shape{};
    int64_t valid_max_iter = 0;
    // HDF5 or .npz file of trajectories in place of random initial states, relative to the folder of the scene file;
    // empty if there is none. Only the Python trainer reads it.
    std::string file{};
    bool fresh = false;  // new training samples in every epoch (fresh_data.h)
    int64_t trained_steps = 2;  // that the loss looks ahead
    int64_t spin_up = 0;  // steps before the first state of a sample
  };
  struct Network {
    std::string python{};  // "module:Class" of the Python trainer, in place of all the rest
    std::string kind;  // "mlp", "resnet" or "unet"
    std::vector<int64_t> hidden;  // mlp
    int64_t blocks = 0;  // resnet
    int64_t levels = 0;  // unet
    int64_t width = 0;  // resnet and unet
    bool zero_output = false;  // whether the last layer starts at zero
  };
  struct Training {
    std::string loss;  // "nmse" or "mse"
    double learning_rate = 0.0;
    double decay = 1.0;  // factor of the learning rate over decay_steps updates, applied smoothly
    int64_t decay_steps = 1;
    std::optional<int64_t> cosine_updates;  // in place of decay: a cosine down to a tenth over this many updates
    int64_t batch = 0;  // samples per update; 0 without a network
    int64_t intervals = 0;  // epochs, or updates without a network; the controller acts once per interval
  };
  struct Parameters {
    std::vector<double> start, reference;
  };
  struct Field {
    // κ = mean·exp(contrast·g), where g is a random Fourier series with this many modes, scaled to max |g| = 1.
    double mean = 0.0, contrast = 0.0;
    int64_t modes = 0;
    int64_t states = 0, state_modes = 0;  // of the initial states, or sources of darcy: also random Fourier series
    int64_t steps = 1, every = 1;  // time steps of each state, and time steps between snapshots
    double noise = 0.0;  // its standard deviation, relative to the root mean square of the snapshots
    double smoothing = 0.0;  // weight of the mean of |∇θ|² in the loss; length²
    int64_t seed = 0;
  };
  struct Compare {
    int64_t seeds = 1;
    std::vector<int64_t> constant;  // the constant K, one row each
    std::optional<double> growth;  // PRDP with K ← growth·K, as a row of its own
    std::optional<double> rtol;  // the converged K with this tolerance, as a row of its own
    std::vector<int64_t> schedule;  // manual schedule: start, and step per interval; empty if there is none
    std::optional<double> target;  // iterations are counted until the metric reaches this value
  };

  std::string name, path, text;  // text: the file as it was read
  std::string title;
  Task task = Task::kEmulator;
  at::ScalarType dtype = at::kFloat;
  at::Device device = at::kCPU;  // where data, network and solves live
  Physics physics;
  Solver solver{Method::kJacobi, 1};  // converged: max_iter is K_ε
  Backward backward = Backward::kImplicit;
  OnFailure on_failure = OnFailure::kReturn;  // or kZeroGrad; a failed sample never stops a training
  Start start = Start::kZero;
  Data data;
  Network network;
  Training training;
  Parameters parameters;
  Field field;
  PRDPSettings prdp;
  Compare compare;

  bool trains_network() const { return task == Task::kEmulator || task == Task::kCorrector; }
  /// How many steps an update makes one after the other. K is the budget of each of their solves.
  int64_t executions() const { return task == Task::kCorrector ? data.trained_steps : 1; }
  /// The solver of data and references: exact if that is cheap, otherwise iterative, with an error below the rounding
  /// of float32.
  Solver reference_solver() const;
  /// The options of the scene's solves, with this solver.
  SolveOptions options(Solver solver) const;
  /// The scene's step with this solver. Not for the task "field", whose equation changes in every update.
  Stepper stepper(Solver solver) const;
  /// Sets `backward` by its name. Raises ValueError for an unknown name, and for one that would leave the task without
  /// a gradient.
  void set_backward(const std::string& name);
  /// Sets `device` by its name. Raises ValueError for what names none.
  void set_device(const std::string& name);
  /// The learning rate of an update, counted from 0.
  double learning_rate(int64_t update) const;
};

/// A key of a scene file, as the documentation lists it.
struct SceneKey {
  std::string table;  // "physics"; empty at the top level
  std::string name;  // "nu"
  std::string value;  // "number >= 0"
  std::string unit;  // "length²/time"; empty: none
  std::optional<std::string> otherwise;  // the default; nullopt: the key must be given where it applies
  std::string when;  // "not for `poisson`"; empty: always
  std::string means;  // "viscosity or diffusivity"
};
/// Every key that a scene may have, in the order in which they are read.
std::vector<SceneKey> scene_keys();

/// The type of the tensors and all keys of [physics] and [data], with their values: what the data depend on.
std::string data_settings(const Scene& scene);

/// Reads a scene file. Raises ValueError for a mistake; it names the file, the line, the key and what is allowed.
Scene read_scene(const std::string& path);
/// The same for the text of a scene, such as that in a record. `path` is used in errors and for the name of the scene.
Scene parse_scene(const std::string& text, const std::string& path);

}  // namespace prdp
