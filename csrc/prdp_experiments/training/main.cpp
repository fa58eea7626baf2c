/// prdp_train SCENE.toml: the trainings of `prdp train` as a pure C++ program.
#include <ATen/Parallel.h>
#include <torch/version.h>

#include <CLI/CLI.hpp>
#include <algorithm>
#include <charconv>
#include <csignal>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <optional>
#include <thread>
#include <utility>
#include <vector>

#include "prdp/error_text.h"
#include "prdp/threads/interruption.h"
#include "prdp_experiments/files/record.h"
#include "prdp_experiments/files/seal.h"
#include "prdp_experiments/files/whole_files.h"
#include "prdp_experiments/scenes/device.h"
#include "prdp_experiments/training/loss.h"
#include "prdp_experiments/training/training.h"

namespace {

using prdp::Json;
namespace fs = std::filesystem;

volatile std::sig_atomic_t interrupted = 0;  // the signal
struct Interrupted : std::exception {};     // so that it passes through a backward pass
void stop_if_interrupted() {
  if (interrupted) throw Interrupted{};
}

struct Options {
  std::string scene, out, schedule, backward, weights, device;
  int64_t seeds = 1, constant = -1, intervals = 0;
  bool direct = false, prdp = false, resume = false;
};

/// What a record or a checkpoint must agree on to be of the same training, which may go on for more intervals.
struct Identity {
  const prdp::Scene& scene;
  std::string weights;  // that the network begins with, as bytes; empty: those of the seed

  Json settings() const {
    Json all{{"scene", scene.name}, {"text", scene.text}, {"backward", prdp::name(scene.backward)}};
    if (!weights.empty()) all["weights"] = prdp::fingerprint(weights);
    return all;
  }
};

/// The bytes of paths and arguments need not be text.
std::string text_of(const Json& json, int indent = -1) {
  return json.dump(indent, ' ', /*ensure_ascii=*/false, Json::error_handler_t::replace);
}

Json versions() { return {{"prdp_torch", PRDP_VERSION}, {"torch", TORCH_VERSION}}; }

Json machine(const prdp::Scene& scene) {
  return {{"cores", std::thread::hardware_concurrency()},
          {"threads", at::get_num_threads()},
          {"device", scene.device.str()}};
}

Json record(const Identity& identity, const std::string& label, int64_t seed, const std::string& command,
            const prdp::train::Curves& c) {
  auto all = identity.settings();
  all["intervals"] = identity.scene.training.intervals;
  Json curves;
  prdp::train::each_curve(c, [&](const char* name, const auto& values) { curves[name] = values; });
  if (!c.diverged.empty()) curves["diverged"] = c.diverged;
  if (!c.warning.empty()) curves["warning"] = c.warning;
  Json record{{"label", label},
              {"seed", seed},
              {"settings", all},
              {"versions", versions()},
              {"machine", machine(identity.scene)},
              {"command", command},
              {"curves", curves}};
  if (!c.weights.empty()) record["weights"] = prdp::fingerprint(c.weights);
  return record;
}

/// Beside the record to come.
prdp::Checkpoint checkpoint_of(const fs::path& record, const Identity& identity, const std::string& label,
                               int64_t seed) {
  const Json all{{"trainer", "C++"},
                 {"label", label},
                 {"seed", seed},
                 {"settings", identity.settings()},
                 {"versions", versions()}};
  return {fs::path(record).replace_extension(".checkpoint"), text_of(all)};
}

/// How many intervals a record has, if it is of this training.
std::optional<int64_t> intervals_if_same(const Json& record, const Identity& identity) {
  auto found = record.at("settings");
  const auto intervals = found.at("intervals").get<int64_t>();
  found.erase("intervals");
  return found == identity.settings() ? std::optional(intervals) : std::nullopt;
}

/// Whether the record is of this training, finished, and its weights are there. Throws if they are damaged, or if it is
/// of another length and nothing is left to go on from.
bool is_done(const fs::path& path, const Identity& identity, prdp::Checkpoint& checkpoint) {
  const auto kept = prdp::read_training(path);
  if (!kept) return false;
  const auto intervals = intervals_if_same(*kept, identity);
  const auto wanted = identity.scene.training.intervals;
  if (!intervals) return false;
  if (*intervals == wanted) {
    if (kept->contains("weights") && !prdp::read_weights(path, kept->at("weights").get<std::string>())) return false;
    checkpoint.remove_before(path);
    return true;
  }
  if (checkpoint.find().empty()) prdp::refuse_finished(path, *intervals, wanted);
  return false;
}

/// What a training puts in the place of a finished record; empty if there is none, or it is kept.
std::string replaced_by(const Identity& identity, const fs::path& path, bool resume) {
  try {
    const auto kept = prdp::read_training(path);
    if (!kept) return {};
    const auto intervals = intervals_if_same(*kept, identity);
    if (intervals && resume) return {};
    const bool same = intervals == identity.scene.training.intervals;
    return "'" + path.string() + (same ? "', of the same settings" : "', of other settings");
  } catch (const c10::Error&) {  // with --resume, who reads it says so
    return resume ? "" : "'" + path.string() + "', which is damaged";
  }
}

/// Throws where one of these trainings would overwrite a checkpoint: of other settings, or of its own where it begins
/// anew. Finished records that will be replaced are told on stderr.
template <class FileOf>
void refuse_to_lose(const Options& options, const Identity& identity, const std::string& label, const FileOf& file_of) {
  std::vector<std::string> replaced;
  for (int64_t seed = 0; seed < options.seeds; ++seed) {
    const auto file = file_of(seed);
    auto checkpoint = checkpoint_of(file, identity, label, seed);
    checkpoint.refuse_other(file);
    if (!options.resume) checkpoint.refuse_to_lose(file);
    if (auto said = replaced_by(identity, file, options.resume); !said.empty()) replaced.push_back(std::move(said));
  }
  if (replaced.empty()) return;
  const auto others = replaced.size() > 1 ? ", and " + std::to_string(replaced.size() - 1) + " more" : "";
  std::fprintf(stderr, "prdp_train: replaces when it ends: %s%s\n", replaced.front().c_str(), others.c_str());
}

std::pair<int64_t, int64_t> parse_schedule(const std::string& text) {
  const char *begin = text.data(), *end = begin + text.size();
  std::pair<int64_t, int64_t> schedule{};
  const auto start = std::from_chars(begin, end, schedule.first);
  const auto step = std::from_chars(std::min(start.ptr + 1, end), end, schedule.second);
  if (start.ec != std::errc() || step.ec != std::errc() || *start.ptr != ':' || step.ptr != end ||
      std::max(schedule.first, schedule.second) > prdp::kMostCounted)
    throw std::runtime_error("--schedule: expected START:STEP, two whole numbers up to " +
                             std::to_string(prdp::kMostCounted) + ", got '" + text + "'");
  return schedule;
}

prdp::train::Refinement refinement_of(const Options& options, const prdp::Scene& scene) {
  if (options.constant >= 0) return prdp::train::constant(options.constant);
  if (options.direct) return prdp::train::direct();
  if (options.prdp) return prdp::train::prdp(scene);
  if (options.schedule.empty()) return prdp::train::automatic();
  const auto [start, step] = parse_schedule(options.schedule);
  const int64_t most = scene.solver.max_iter.expect_int();
  if (start > most)
    throw std::runtime_error("--schedule: START must be at most max_iter of the scene, " + std::to_string(most) +
                             ", got " + std::to_string(start));
  return prdp::train::schedule(start, step, most);
}

/// Why a training is lost; empty if it is not.
std::string why_lost(const prdp::train::Curves& curves) {
  return curves.diverged.empty() ? prdp::why_lost(curves.error.front(), curves.error.back()) : curves.diverged;
}

/// Returns the exit status: 1 where a training diverged.
int run(const Options& options, const std::string& command) {
  auto scene = prdp::read_scene(options.scene);
  if (!options.backward.empty()) scene.set_backward(options.backward);
  if (options.intervals > 0) scene.training.intervals = options.intervals;
  if (!options.device.empty()) scene.set_device(options.device);
  prdp::check_device(scene.device);
  const auto refinement = refinement_of(options, scene);
  const Identity identity{scene, options.weights.empty() ? "" : prdp::read_whole("weights", options.weights)};
  const auto folder = fs::path(options.out.empty() ? "runs/" + scene.name + "-cpp" : options.out) / refinement.label;
  std::error_code error;
  fs::create_directories(folder, error);
  if (error) throw std::runtime_error("--out: cannot write to '" + folder.string() + "': " + error.message());
  const prdp::FolderLock lock(folder);

  std::printf("%s: %s, %s\n", scene.name.c_str(), refinement.label.c_str(), scene.title.c_str());
  const auto file_of = [&](int64_t seed) { return folder / ("seed_" + std::to_string(seed) + ".json"); };
  refuse_to_lose(options, identity, refinement.label, file_of);
  int diverged = 0;
  for (int64_t seed = 0; seed < options.seeds; ++seed) {
    const auto file = file_of(seed);
    prdp::settle_weights(file);
    auto checkpoint = checkpoint_of(file, identity, refinement.label, seed);
    if (options.resume && is_done(file, identity, checkpoint)) continue;
    if (!options.resume) checkpoint.remove();
    const auto on_interval = [&, first = true](int64_t done, double metric, int64_t k) mutable {
      stop_if_interrupted();
      if (std::exchange(first, false) || done % 10 == 0)
        std::printf("seed %ld  interval %4ld  metric %.4e  K %ld\n", seed, done, metric, k);
    };
    const auto on_data = [slow = !scene.physics.direct_is_cheap()](int64_t done, int64_t total) {
      stop_if_interrupted();
      if (slow) std::fprintf(stderr, "data: %ld of %ld reference steps\n", done, total);
    };
    const auto curves = prdp::train::train(scene, refinement, seed, options.weights, on_interval, checkpoint, on_data);
    const auto text = text_of(record(identity, refinement.label, seed, command, curves), 1);
    prdp::write_training(file, text, curves.weights);
    checkpoint.remove();
    if (curves.diverged.empty())
      std::printf("seed %ld  final metric %.4e  written to %s\n", seed, curves.metric.back(), file.c_str());
    if (!curves.warning.empty())
      std::fprintf(stderr, "prdp_train: warning: seed %ld, %s\n", seed, curves.warning.c_str());
    if (const auto why = why_lost(curves); !why.empty()) {
      ++diverged;
      std::fprintf(stderr, "prdp_train: seed %ld diverged, %s\n", seed, why.c_str());
    }
  }
  return diverged > 0 ? 1 : 0;
}

}  // namespace

int main(int argc, char** argv) {
  prdp::speak_python();  // as the keys of scenes do
  CLI::App app("Train a scene through differentiable physics that stops early, in C++.");
  Options options;
  const auto positive = CLI::Range(int64_t{1}, prdp::kMostCounted);
  app.add_option("scene", options.scene, "scene file (.toml)")->required();
  app.add_option("--seeds", options.seeds, "how many seeds, from 0")->check(positive);
  auto* k = app.add_option("--constant", options.constant, "constant K")->check(positive);
  auto* s = app.add_option("--schedule", options.schedule, "START:STEP, K grows by STEP an interval up to the scene's");
  auto* d = app.add_flag("--direct", options.direct, "the exact solver in place of the scene's");
  auto* a = app.add_flag("--auto")->description("a tolerance tied to the error, with nothing to choose; the default");
  auto* p = app.add_flag("--prdp", options.prdp, "PRDP with the scene's settings");
  app.add_option("--backward", options.backward, "implicit, unrolled or (corrector) none, in place of the scene's");
  app.add_option("--device", options.device, "cpu, cuda or cuda:N, in place of the scene's");
  app.add_option("--intervals", options.intervals, "epochs (or updates) in place of the scene's")->check(positive);
  app.add_option("--out", options.out, "folder for the records; default runs/SCENE-cpp");
  app.add_option("--weights", options.weights, "file of weights that the network begins with, in place of the seed's");
  app.add_flag("--resume", options.resume, "keep finished trainings, go on from checkpoints");
  app.set_version_flag("--version", "prdp_torch " PRDP_VERSION ", torch " TORCH_VERSION);
  k->excludes(s)->excludes(d)->excludes(a)->excludes(p);
  s->excludes(d)->excludes(a)->excludes(p);
  d->excludes(a)->excludes(p);
  a->excludes(p);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : 2;
  }
  const auto on_signal = [](int signal) {
    interrupted = signal;
    std::signal(signal, SIG_DFL);  // a second one ends it at once
  };
  for (const int signal : {SIGINT, SIGTERM}) std::signal(signal, on_signal);
  std::signal(SIGPIPE, SIG_IGN);  // the training goes on where nobody takes its lines
  prdp::interruption::set_check(stop_if_interrupted);
  std::setvbuf(stdout, nullptr, _IOLBF, BUFSIZ);  // a log can be followed
  std::string command;
  for (int i = 0; i < argc; ++i) command += (i ? " " : "") + std::string(argv[i]);

  try {
    return run(options, command);
  } catch (const Interrupted&) {
    std::fprintf(stderr,
                 "prdp_train: interrupted; --resume keeps finished trainings and goes on from the "
                 "last checkpoint\n");
    return 128 + interrupted;
  } catch (const c10::Error& error) {
    std::fprintf(stderr, "prdp_train: %s\n", prdp::sentence(error.what_without_backtrace()).c_str());
  } catch (const std::exception& error) {
    std::fprintf(stderr, "prdp_train: %s\n", prdp::sentence(error.what()).c_str());
  }
  return 2;
}
