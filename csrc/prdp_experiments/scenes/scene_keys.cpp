#include <algorithm>
#include <filesystem>
#include <functional>
#include <numeric>

#include "prdp/solvers/methods.h"
#include "prdp_experiments/files/whole_files.h"
#include "prdp_experiments/scenes/key_recorder.h"
#include "prdp_experiments/scenes/key_values.h"
#include "prdp_experiments/scenes/scene.h"
#include "prdp_experiments/scenes/toml_section.h"

/// Every key of a scene file is declared here, once: where it goes, what it may be, its unit and its meaning.
/// The functions run on a TomlSection to read a file, and on a KeyRecorder to list the keys.
namespace prdp {

namespace {

using Task = Scene::Task;

When corrector(const Scene& s) { return {s.task == Task::kCorrector, "only for `corrector`"}; }
When kolmogorov(const Scene& s) { return {s.physics.is_kolmogorov(), "only for `kolmogorov`"}; }
When field(const Scene& s) { return {s.task == Task::kField, "only for `field`"}; }
When parameters(const Scene& s) { return {s.task == Task::kParameters, "only for `parameters`"}; }
When network(const Scene& s) { return {s.trains_network(), "only for `emulator` and `corrector`"}; }
When no_network(const Scene& s) { return {!s.trains_network(), "only for `parameters` and `field`"}; }

Task task_from_name(const std::string& name) {
  if (name == "corrector") return Task::kCorrector;
  if (name == "field") return Task::kField;
  return name == "emulator" ? Task::kEmulator : Task::kParameters;
}
Preconditioner preconditioner_from_name(const std::string& name) {
  if (name == "none") return {};
  return name == "multigrid" ? Preconditioner::multigrid() : Preconditioner::diagonal();
}
at::ScalarType dtype_from_name(const std::string& name) { return name == "float32" ? at::kFloat : at::kDouble; }

/// A corrector has a gradient of its own, the other tasks have the solver's alone.
Choices backwards(const Scene& scene) { return {"implicit", "unrolled", {"none", corrector(scene)}}; }

template <class Section>
void read_physics(Section& s, Scene& scene) {
  auto& p = scene.physics;
  const When grid{!field(scene).holds && !corrector(scene).holds, "only for `emulator` and `parameters`"};
  const Choices equations{
      {"poisson", grid},
      {"heat", grid},
      {"burgers", grid},
      {"navier_stokes", corrector(scene)},
      {"kolmogorov", corrector(scene)},
      {"diffusion", field(scene)},
      {"darcy", {field(scene).holds || scene.task == Task::kEmulator, "only for `field` and `emulator`"}}};
  s.choice(p.equation, equations, {"equation", "the equation"});
  s.wholes(p.shape, 1, {"shape", "unknowns per axis, in 1 to 3 axes: `[N]`, `[Ny, Nx]` or `[Nz, Ny, Nx]`"});
  s.check(!p.shape.empty() && p.shape.size() <= 3, "shape", "expected 1 to 3 extents");
  s.check(p.shape.size() == 2 || !corrector(scene).holds, "shape", "expected 2 extents");
  s.check(std::accumulate(p.shape.begin(), p.shape.end(), 1.0, std::multiplies<>()) <= kMostCounted, "shape",
          "expected at most 1000000000 unknowns");
  s.sides(p.lengths, p.shape.size(),
          {.name = "length",
           .means = "side of the domain, one number or one per axis in the order of `shape`",
           .unit = "length",
           .optional = true});
  const When has_nu{p.equation != "poisson" && p.equation != "diffusion" && !p.is_darcy(),
                    "not for `poisson`, `diffusion` and `darcy`"};
  const When has_dt{p.equation != "poisson" && !p.is_darcy(), "not for `poisson` and `darcy`"};
  s.at_least(p.nu, 0.0, {"nu", "viscosity or diffusivity", "length²/time", has_nu});
  s.above(p.dt, 0.0, {"dt", "time step", "time", has_dt});
  s.above(p.amplitude, 0.0,
          {"amplitude", "largest acceleration by the force, along x", "length/time²", kolmogorov(scene)});
  s.whole(p.waves, 1, {"waves", "waves of the force along y", "", kolmogorov(scene)});
}

template <class Section>
void read_solver(Section& s, Scene& scene) {
  const When spectrum{!scene.physics.periodic() && !scene.physics.is_darcy(), "only for `heat` and `poisson`"};
  const When coarse_grids{scene.physics.equation != "navier_stokes", "not for `navier_stokes`"};
  Choices methods;
  for (const auto& method : kTraits)
    methods.emplace_back(method.name.data(), method.made_for == MadeFor::kKnownSpectrum ? spectrum
                                             : method.method == Method::kMultigrid      ? coarse_grids
                                                                                        : When{});
  s.choice(scene.solver.method, method_from_name, methods, {"method", "the solver"});
  const When takes_one{traits(scene.solver.method).takes_preconditioner,
                       "only for `cg`, `bicgstab`, `gmres` and `minres`"};
  std::string preconditioner = scene.solver.method == Method::kMultigrid ? "multigrid" : "none";
  s.choice(preconditioner, {"none", "diagonal", "multigrid"},
           {.name = "preconditioner", .means = "the preconditioner", .when = takes_one, .optional = true});
  scene.solver.preconditioner = preconditioner_from_name(preconditioner);
  s.count(scene.solver.max_iter, 1,
          {"max_iter", "K of the converged solver, K_ε in the paper", "iterations (`gmres`: cycles)"});
  s.at_least(scene.solver.rtol, 0.0, {"rtol", "relative residual at which a solve stops; 0 runs exactly K iterations"});
  const When gmres{traits(scene.solver.method).counts == Counts::kCycles, "only for `gmres`"};
  s.count(scene.solver.restart, 1, {"restart", "restart length", "products per cycle", gmres});
  s.choice(scene.backward, backward_from_name, backwards(scene), {"backward", "how gradients are computed"});
  s.choice(scene.on_failure, on_failure_from_name, {"return", "zero_grad"},
           {.name = "on_failure", .means = "whether a sample whose solve failed gets a gradient", .optional = true});
  s.choice(scene.start, start_from_name, {"zero", "state"},
           {.name = "start", .means = "where the solves start", .optional = true});
}

template <class Section>
void check_finer(Section& s, const Scene& scene, bool given) {
  const auto &reference = scene.data.reference_shape, &coarse = scene.physics.shape;
  const bool multiple = scene.physics.is_kolmogorov();
  const auto is_finer = [&](int64_t fine, int64_t n) {
    return multiple ? fine % n == 0 && fine / n == reference[0] / coarse[0] : fine == 2 * n + 1;
  };
  s.check(!given || std::equal(reference.begin(), reference.end(), coarse.begin(), coarse.end(), is_finer),
          "reference_shape",
          multiple ? "expected the same multiple of each N of physics.shape"
                   : "expected 2 N + 1 for each N of physics.shape");
}

template <class Section>
void read_data(Section& s, Scene& scene) {
  auto& d = scene.data;
  const When in_time{!scene.physics.is_darcy(), "not for `darcy`"};
  s.text(d.file, {.name = "file",
                  .means = "HDF5 or `.npz` file of trajectories, in place of random initial states",
                  .unit = "path relative to the scene file",
                  .when = in_time,
                  .optional = true});
  const When random{d.file.empty(), "not with `file`"};
  const When emulator{scene.task == Task::kEmulator, "only for `emulator`"};
  const When flow = corrector(scene) && random;
  s.wholes(
      d.reference_shape, 1,
      {"reference_shape",
       "grid of the reference solution: 2 N + 1 for each N of `physics.shape`; for `kolmogorov` the same multiple of "
       "each N",
       "", flow});
  check_finer(s, scene, flow.holds);
  s.count(d.spin_up, 0,
          {"spin_up", "how far random flows are followed before the data begin", "time steps",
           kolmogorov(scene) && random});
  s.whole(d.trained_steps, 2,
          {.name = "trained_steps",
           .means = "how many steps in a row the loss covers",
           .unit = "time steps",
           .when = corrector(scene),
           .optional = true});
  s.whole(d.modes, 1,
          {"modes", "sine and cosine modes of the random initial states; of `darcy` of log κ", "", emulator && random});
  s.whole(d.seed, 0, {"seed", "seed of the data; every training of the scene uses the same data", "", random});
  s.count(d.valid_max_iter, 1,
          {"valid_max_iter", "K of the converged solves behind the validation metric", "iterations", corrector(scene)});
  s.flag(d.fresh, {.name = "fresh",
                   .means = "whether every epoch has new training samples, so that none is seen twice",
                   .when = random,
                   .optional = true});
  s.whole(d.train, 1, {"train", "training samples, with `fresh` in each epoch; with `file`, trajectories"});
  s.whole(d.valid, 1, {"valid", "validation samples"});
  s.whole(d.valid_steps, 1,
          {"valid_steps", "validation horizon: how many steps the network makes before its error is measured",
           "time steps", in_time});
}

template <class Section>
void read_network(Section& s, Scene& scene) {
  auto& n = scene.network;
  s.choice(n.kind, {"mlp", "resnet", "unet"}, {"kind", "multilayer perceptron, residual convolution network or U-net"});
  const When mlp{n.kind == "mlp", "only for `mlp`"}, resnet{n.kind == "resnet", "only for `resnet`"};
  const When unet{n.kind == "unet", "only for `unet`"}, convolutions{!mlp.holds, "not for `mlp`"};
  s.wholes(n.hidden, 1, {"hidden", "widths of the hidden layers", "", mlp});
  s.whole(n.blocks, 1, {"blocks", "residual blocks", "", resnet});
  s.whole(n.levels, 1, {"levels", "how often the grid is halved, and the channels doubled", "", unet});
  s.whole(n.width, 1, {"width", "channels of the blocks; of `unet` on the finest grid", "", convolutions});
  constexpr int64_t kWidest = 1'000'000, kMostBlocks = 10'000, kMostLevels = 10;
  s.check(std::all_of(n.hidden.begin(), n.hidden.end(), [](int64_t width) { return width <= kWidest; }), "hidden",
          "expected layers of at most 1000000 units");
  s.check(n.levels <= kMostLevels, "levels", "expected at most 10 levels");
  const int64_t levels = std::min(n.levels, kMostLevels);
  s.check(n.width <= kWidest >> levels, "width", "expected at most 1000000 channels in a block");
  const auto& shape = scene.physics.shape;
  s.check(std::all_of(shape.begin(), shape.end(), [&](int64_t extent) { return extent % (1 << levels) == 0; }),
          "levels", "expected 2^levels to divide each N of physics.shape");
  s.check(n.blocks <= kMostBlocks, "blocks", "expected at most 10000 blocks");
  s.flag(n.zero_output, {.name = "zero_output", .means = "whether the last layer starts at zero", .optional = true});
}

template <class Section>
void read_training(Section& s, Scene& scene) {
  auto& t = scene.training;
  s.above(t.learning_rate, 0.0,
          {"learning_rate", "initial learning rate of Adam, or of gradient descent for `parameters`"});
  const When adam{!parameters(scene).holds, "not for `parameters`"};
  s.whole(t.cosine_updates, 1,
          {"cosine_updates",
           "in place of `decay`: the learning rate falls to a tenth over this many updates, along a cosine", "updates",
           adam});
  const When exponential = adam && When{!t.cosine_updates, "not with `cosine_updates`"};
  s.above(
      t.decay, 0.0,
      {"decay", "factor of the learning rate over `decay_steps` updates, applied smoothly; or give `cosine_updates`",
       "", exponential});
  s.whole(t.decay_steps, 1, {"decay_steps", "see `decay`", "updates", exponential});
  s.choice(t.loss, {"nmse", "mse"},
           {"loss", "mean of ‖u - u_ref‖²/‖u_ref‖² over the samples, or mean squared error", "", network(scene)});
  s.whole(t.batch, 1, {"batch", "samples per update", "", network(scene)});
  s.count(t.intervals, 1, {"epochs", "length of the training", "", network(scene)});
  s.count(t.intervals, 1, {"updates", "length of the training", "", no_network(scene)});
}

template <class Section>
void read_parameters(Section& s, Scene& scene) {
  auto& p = scene.parameters;
  s.numbers(p.start, {"start", "θ at the beginning, at least one number"});
  s.numbers(p.reference, {"reference", "θ that should be found, as many numbers as `start`"});
  s.check(!p.start.empty(), "start", "expected at least one amplitude");
  s.check(p.start.size() == p.reference.size(), "reference", "expected as many numbers as start");
}

template <class Section>
void read_field(Section& s, Scene& scene) {
  auto& f = scene.field;
  const When in_time{!scene.physics.is_darcy(), "not for `darcy`"};
  s.above(f.mean, 0.0, {"mean", "geometric mean of κ, and the field to start from", "length²/time"});
  s.at_least(f.contrast, 0.0, {"contrast", "largest |log(κ/mean)| of the field to be found"});
  s.whole(f.modes, 1, {"modes", "sine and cosine modes of log κ"});
  s.whole(f.states, 1, {"states", "initial states; of `darcy` sources, each with a pressure of its own"});
  s.whole(f.state_modes, 1, {"state_modes", "sine and cosine modes of the initial states or sources"});
  s.count(f.steps, 1, {"steps", "how far each state is followed", "time steps", in_time});
  s.whole(f.every, 1, {"every", "time between snapshots, at most `steps`", "time steps", in_time});
  s.check(f.every <= f.steps, "every", "must be <= steps, for there to be a snapshot");
  s.at_least(f.noise, 0.0,
             {"noise", "standard deviation of the noise, relative to the root mean square of the snapshots"});
  s.at_least(f.smoothing, 0.0, {"smoothing", "weight of the mean of |∇ log κ|² in the loss", "length²"});
  s.whole(f.seed, 0, {"seed", "seed of the field and of the initial states or sources"});
}

template <class Section>
void read_prdp(Section& s, Scene& scene) {
  auto& p = scene.prdp;
  s.above(p.tau_step, 0.0,
          {"tau_step", "the metric is on a plateau if the last L̃ is above `tau_step` times the `delta`-th last one"});
  s.above(p.tau_stop, 0.0,
          {"tau_stop",
           "on a plateau, K is raised only if L̃ is below `tau_stop` times its value at the last refinement, "
           "or has grown since"});
  s.whole(p.delta, 2, {"delta", "how far back the plateau test looks; 2 compares the last two values", "intervals"});
  s.whole(p.window, 1,
          {"window", "length of the exponential mean, α = 2/(window + 1); 1 does not smooth", "intervals"});
  s.whole(p.initial, 0, {"initial", "K at the start", "iterations"});
  s.whole(p.increment, 1, {"increment", "how much a refinement adds to K", "iterations"});
  s.whole(p.maximum, {p.initial, "`initial`"}, {"maximum", "K is never raised beyond it", "iterations"});
  s.at_least(p.growth, 1.0,
             {.name = "growth",
              .means = "a refinement raises K to `growth`·K where that is more than K + `increment`",
              .optional = true});
  s.share(p.adjoint_ratio, {"adjoint_ratio", "the adjoint solve gets ⌈`adjoint_ratio`·K⌉ iterations"});
}

template <class Section>
void read_compare(Section& s, Scene& scene) {
  auto& c = scene.compare;
  s.count(c.seeds, 1, {"seeds", "seeds per row"});
  s.wholes(c.constant, 0, {"constant", "one row for each constant K", "iterations"});
  s.above(c.growth, 1.0, {"growth", "adds a row: PRDP with this `growth`"});
  s.above(c.rtol, 0.0, {"rtol", "adds a row: the K of the converged solver with this tolerance"});
  s.above(c.target, 0.0, {"target", "iterations are counted only until the metric reaches this value"});
  s.wholes(c.schedule, 0,
           {.name = "schedule",
            .means = "two numbers, adds a row: K is their sum in the first interval, and grows by the second in each "
                     "that follows",
            .unit = "iterations",
            .optional = true});
  s.check(c.schedule.empty() || c.schedule.size() == 2, "schedule", "expected two whole numbers, start and step");
}

template <class Section>
void read_all(Section& s, Scene& scene) {
  s.text(scene.title, {"title", "one line for lists and reports"});
  s.choice(scene.task, task_from_name, {"emulator", "corrector", "parameters", "field"},
           {"task",
            "what is trained: a network that replaces a time step, a network that corrects a coarse solver, "
            "amplitudes of the right-hand side, or a diffusivity field"});
  s.choice(scene.dtype, dtype_from_name, {"float32", "float64"}, {"dtype", "type of all tensors"});
  s.device(
      scene.device,
      {.name = "device", .means = "where data, network and solves live; `cuda:1` is the second GPU", .optional = true});
  s.section(scene, read_physics<Section>, {"physics", "the equation"});
  s.section(scene, read_solver<Section>, {"solver", "the solver in the training"});
  s.section(scene, read_data<Section>, {"data", "training and validation samples", "", network(scene)});
  s.section_or_text(scene, scene.network.python, read_network<Section>, "module:Class",
                    {"network", "the network, or a class of your own for the Python trainer", "", network(scene)});
  const auto& own = scene.network.python;
  const auto colon = own.find(':');
  const bool two_names = colon != own.npos && colon > 0 && colon + 1 < own.size() && own.rfind(':') == colon;
  s.check(own.empty() || two_names, "network", "expected a table, or \"module:Class\"");
  s.section(scene, read_training<Section>, {"training", "loss, optimiser and length"});
  s.section(scene, read_field<Section>, {"field", "the diffusivity field and its snapshots", "", field(scene)});
  s.section(scene, read_parameters<Section>, {"parameters", "the amplitudes", "", parameters(scene)});
  s.check(scene.physics.shape.size() == 1 || !parameters(scene).holds, "physics",
          "the task 'parameters' is one-dimensional");
  s.section(scene, read_prdp<Section>,
            {.name = "prdp",
             .means = "settings of PRDP; without the table, the defaults of `PRDPController`",
             .optional = true});
  s.section(scene, read_compare<Section>, {"compare", "rows of `prdp compare`"});
}

}  // namespace

void Scene::set_backward(const std::string& name) {
  std::vector<std::string> known;
  for (const auto& choice : backwards(*this))
    if (choice.when.holds) known.emplace_back(choice.name);
  TORCH_CHECK_VALUE(std::find(known.begin(), known.end(), name) != known.end(), "backward: expected ",
                    c10::Join(" or ", known), " for this scene, got '", name, "'");
  backward = backward_from_name(name);
}

std::vector<SceneKey> scene_keys() {
  std::vector<SceneKey> keys;
  KeyRecorder list(keys, "");
  Scene defaults;
  read_all(list, defaults);
  return keys;
}

std::string data_settings(const Scene& scene) {
  KeyValues values;
  Scene read = scene;
  read_physics(values, read);
  read_data(values, read);
  return c10::str(scene.dtype, values.line());
}

Scene read_scene(const std::string& path) { return parse_scene(read_whole("scene", path), path); }

Scene parse_scene(const std::string& text, const std::string& path) {
  const auto table = parse_toml(text, path);
  Scene scene;
  scene.path = path;
  scene.name = std::filesystem::path(path).stem().string();
  scene.text = text;
  TomlSection s(table, path, "");
  read_all(s, scene);
  s.finish();
  return scene;
}

}  // namespace prdp
