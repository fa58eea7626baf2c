#include "prdp/scenes/scene.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <numbers>

#include "prdp/scenes/files.h"
#include "prdp/scenes/toml_section.h"
#include "prdp/solvers/methods.h"

namespace prdp {

namespace {

using Task = Scene::Task;

/// The derivatives that a task can be trained with: a corrector has a gradient of its own, the others
/// have the solver's alone.
std::vector<std::string> backwards(Task task) {
  if (task == Task::kCorrector) return {"implicit", "unrolled", "none"};
  return {"implicit", "unrolled"};
}

Task read_task(TomlSection& s) {
  const auto name = s.choice("task", {"emulator", "corrector", "parameters", "field"});
  if (name == "corrector") return Task::kCorrector;
  if (name == "field") return Task::kField;
  return name == "emulator" ? Task::kEmulator : Task::kParameters;
}

Scene::Physics read_physics(TomlSection s, Task task) {
  Scene::Physics p;
  const bool flow = task == Task::kCorrector;
  std::vector<std::string> equations{"poisson", "heat", "burgers"};
  if (flow) equations = {"navier_stokes"};
  if (task == Task::kField) equations = {"diffusion"};
  p.equation = s.choice("equation", equations);
  p.shape = s.wholes("shape", 1);
  if (p.shape.empty() || p.shape.size() > 3) s.fail("shape", "expected 1 to 3 extents");
  if (flow && p.shape.size() != 2) s.fail("shape", "expected 2 extents");
  if (p.equation != "poisson" && p.equation != "diffusion") p.nu = s.at_least("nu", 0.0);
  if (p.equation != "poisson") p.dt = s.above("dt", 0.0);
  s.finish();
  return p;
}

void read_solver(TomlSection s, Scene& scene) {
  std::vector<std::string> methods;
  for (const auto& method : kTraits) {
    const bool fits = method.made_for != MadeFor::kKnownSpectrum || !scene.physics.periodic();  // heat and Poisson
    if (fits && method.preconditioner == Preconditioner::kNone) methods.emplace_back(method.name);
  }
  scene.solver.method = method_from_name(s.choice("method", methods));
  scene.solver.max_iter = s.count("max_iter", 1);
  scene.solver.rtol = s.at_least("rtol", 0.0);
  if (traits(scene.solver.method).counts == Counts::kCycles) scene.solver.restart = s.count("restart", 1);
  scene.backward = backward_from_name(s.choice("backward", backwards(scene.task)));
  if (s.has("on_failure")) scene.on_failure = on_failure_from_name(s.choice("on_failure", {"return", "zero_grad"}));
  if (s.has("start")) scene.start = start_from_name(s.choice("start", {"zero", "state"}));
  s.finish();
}

Scene::Data read_data(TomlSection s, const Scene& scene) {
  Scene::Data d;
  const bool corrector = scene.task == Task::kCorrector;
  if (s.has("file")) {
    d.file = s.text("file");
  } else {
    if (corrector) {
      d.reference_shape = s.wholes("reference_shape", 1);
      auto finer = scene.physics.shape;
      for (auto& n : finer) n = 2 * n + 1;
      if (d.reference_shape != finer)
        s.fail("reference_shape", "expected 2 N + 1 for each N of physics.shape");
    } else {
      d.modes = s.whole("modes", 1);
    }
    d.seed = s.whole("seed", 0);
  }
  if (corrector) d.valid_max_iter = s.count("valid_max_iter", 1);
  d.train = s.whole("train", 1);
  d.valid = s.whole("valid", 1);
  d.valid_steps = s.whole("valid_steps", 1);
  s.finish();
  return d;
}

Scene::Network read_network(TomlSection s) {
  Scene::Network n;
  n.kind = s.choice("kind", {"mlp", "resnet"});
  if (n.kind == "mlp") {
    n.hidden = s.wholes("hidden", 1);
  } else {
    n.blocks = s.whole("blocks", 1);
    n.width = s.whole("width", 1);
  }
  n.zero_output = s.flag("zero_output", false);
  s.finish();
  return n;
}

Scene::Training read_training(TomlSection s, const Scene& scene) {
  Scene::Training t;
  t.learning_rate = s.above("learning_rate", 0.0);
  if (scene.task != Task::kParameters) {
    if (s.has("cosine_updates")) {
      t.cosine_updates = s.whole("cosine_updates", 1);
    } else {
      t.decay = s.above("decay", 0.0);
      t.decay_steps = s.whole("decay_steps", 1);
    }
  }
  if (scene.trains_network()) {
    t.loss = s.choice("loss", {"nmse", "mse"});
    t.batch = s.whole("batch", 1);
    t.intervals = s.count("epochs", 1);
  } else {
    t.intervals = s.count("updates", 1);
  }
  s.finish();
  return t;
}

Scene::Parameters read_parameters(TomlSection s) {
  Scene::Parameters p{s.numbers("start"), s.numbers("reference")};
  if (p.start.empty()) s.fail("start", "expected at least one amplitude");
  if (p.start.size() != p.reference.size()) s.fail("reference", "expected as many numbers as start");
  s.finish();
  return p;
}

Scene::Field read_field(TomlSection s) {
  Scene::Field f;
  f.mean = s.above("mean", 0.0);
  f.contrast = s.at_least("contrast", 0.0);
  f.modes = s.whole("modes", 1);
  f.states = s.whole("states", 1);
  f.state_modes = s.whole("state_modes", 1);
  f.steps = s.count("steps", 1);
  f.every = s.whole("every", 1);
  if (f.every > f.steps) s.fail("every", "must be <= steps, for there to be a snapshot");
  f.noise = s.at_least("noise", 0.0);
  f.smoothing = s.at_least("smoothing", 0.0);
  f.seed = s.whole("seed", 0);
  s.finish();
  return f;
}

PRDPSettings read_prdp(TomlSection s) {
  PRDPSettings p;
  p.tau_step = s.above("tau_step", 0.0);
  p.tau_stop = s.above("tau_stop", 0.0);
  p.delta = s.whole("delta", 2);
  p.window = s.whole("window", 1);
  p.initial = s.whole("initial", 0);
  p.increment = s.whole("increment", 1);
  if (s.has("maximum")) p.maximum = s.whole("maximum", p.initial);
  if (s.has("growth")) p.growth = s.at_least("growth", 1.0);
  if (s.has("adjoint_ratio")) p.adjoint_ratio = s.above("adjoint_ratio", 0.0);
  s.finish();
  return p;
}

Scene::Compare read_compare(TomlSection s) {
  Scene::Compare c;
  c.seeds = s.count("seeds", 1);
  c.constant = s.wholes("constant", 0);
  if (s.has("growth")) c.growth = s.above("growth", 1.0);
  if (s.has("rtol")) c.rtol = s.above("rtol", 0.0);
  if (s.has("target")) c.target = s.above("target", 0.0);
  if (s.has("schedule")) {
    c.schedule = s.wholes("schedule", 0);
    if (c.schedule.size() != 2) s.fail("schedule", "expected two whole numbers, start and step");
  }
  s.finish();
  return c;
}

}  // namespace

Solver Scene::reference_solver() const {
  if (physics.direct_is_cheap()) return Direct{};
  return GMRES{.restart = 20, .max_iter = 1000, .rtol = 1e-8};
}

Stepper Scene::stepper(Solver with) const {
  Equation equation{physics.equation, physics.shape, {}, {}};
  if (physics.equation != "poisson") {
    equation.parameters = {physics.dt};
    equation.tensors = {at::scalar_tensor(physics.nu, at::kDouble)};
  }
  return {std::move(equation), options(std::move(with))};
}

SolveOptions Scene::options(Solver with) const {
  return {std::move(with), backward, {}, {}, on_failure, 0, 0, start};
}

void Scene::set_backward(const std::string& name) {
  const auto known = backwards(task);
  TORCH_CHECK_VALUE(std::find(known.begin(), known.end(), name) != known.end(), "backward: unknown name '", name,
                    "' for a scene; allowed: ", c10::Join(", ", known));
  backward = backward_from_name(name);
}

double Scene::learning_rate(int64_t update) const {
  if (training.cosine_updates) {
    const double part = std::min(1.0, static_cast<double>(update) / static_cast<double>(*training.cosine_updates));
    return training.learning_rate * (0.1 + 0.45 * (1.0 + std::cos(std::numbers::pi * part)));
  }
  const double periods = static_cast<double>(update) / static_cast<double>(training.decay_steps);
  return training.learning_rate * std::pow(training.decay, periods);
}

Scene read_scene(const std::string& path) { return parse_scene(read_whole("scene", path), path); }

Scene parse_scene(const std::string& text, const std::string& path) {
  // toml++ ends the process on tables nested a hundred thousand deep; a file of this size cannot hold so many.
  constexpr size_t kLongest = 65536;
  TORCH_CHECK_VALUE(text.size() <= kLongest, "scene: '", path, "' has ", text.size(), " bytes; a scene has at most ",
                    kLongest);

  toml::table table;
  try {
    table = toml::parse(text, path);
  } catch (const toml::parse_error& error) {
    TORCH_CHECK_VALUE(false, path, ":", error.source().begin.line, ": ", error.description());
  } catch (const BrokenToml&) {
    TORCH_CHECK_VALUE(false, path, ": not a TOML file; a key or the name of a table has a character that it cannot have");
  }

  Scene scene;
  scene.path = path;
  scene.name = std::filesystem::path(path).stem().string();
  scene.text = text;
  TomlSection s(table, path, "");
  scene.title = s.text("title");
  scene.task = read_task(s);
  scene.dtype = s.choice("dtype", {"float32", "float64"}) == "float32" ? at::kFloat : at::kDouble;
  scene.physics = read_physics(s.section("physics"), scene.task);
  read_solver(s.section("solver"), scene);
  scene.training = read_training(s.section("training"), scene);
  if (scene.trains_network()) {
    scene.data = read_data(s.section("data"), scene);
    scene.network = read_network(s.section("network"));
  } else if (scene.task == Task::kField) {
    scene.field = read_field(s.section("field"));
  } else {
    scene.parameters = read_parameters(s.section("parameters"));
    if (scene.physics.shape.size() != 1) s.fail("physics", "the task 'parameters' is one-dimensional");
  }
  if (s.has("prdp")) scene.prdp = read_prdp(s.section("prdp"));
  scene.compare = read_compare(s.section("compare"));
  s.finish();
  return scene;
}

}  // namespace prdp
