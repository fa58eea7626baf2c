/// prdp_train SCENE.toml: the trainings of `prdp train` as a pure C++ program.
#include <ATen/Parallel.h>
#include <torch/version.h>

#include <CLI/CLI.hpp>
#include <csignal>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>

#include "training.h"

namespace {

volatile std::sig_atomic_t interrupted = 0;
struct Interrupted {};

nlohmann::ordered_json record(const prdp::Scene& scene, const std::string& label, int64_t seed,
                              const std::string& command, const prdp::train::Curves& c) {
  return {{"scene", scene.name},
          {"label", label},
          {"seed", seed},
          {"settings", scene.text},
          {"command", command},
          {"versions", {{"prdp", PRDP_VERSION}, {"torch", TORCH_VERSION}}},
          {"threads", at::get_num_threads()},
          {"curves",
           {{"update_loss", c.update_loss},
            {"metric", c.metric},
            {"max_iter", c.max_iter},
            {"budget", c.budget},
            {"iterations", c.iterations},
            {"operator_applications", c.operator_applications},
            {"seconds", c.seconds}}}};
}

/// Writes beside the place and moves it there: a file is whole or not there.
void write_whole(const std::filesystem::path& path, const std::string& text) {
  auto unfinished = path;
  unfinished += ".part";
  std::ofstream file(unfinished);
  file << text << '\n';
  file.close();
  if (!file) throw std::runtime_error("cannot write '" + path.string() + "'");
  std::filesystem::rename(unfinished, path);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Train a scene through differentiable physics that stops early, in C++.");
  std::string path, out, schedule;
  int64_t seeds = 1, constant = -1;
  bool direct = false;
  app.add_option("scene", path, "scene file (.toml)")->required();
  app.add_option("--seeds", seeds, "how many seeds, from 0")->check(CLI::PositiveNumber);
  auto* k = app.add_option("--constant", constant, "constant K in place of PRDP")->check(CLI::NonNegativeNumber);
  auto* s = app.add_option("--schedule", schedule, "START:STEP, K grows with every interval");
  auto* d = app.add_flag("--direct", direct, "the exact solver in place of the scene's");
  app.add_option("--out", out, "folder for the records; default runs/SCENE-cpp");
  k->excludes(s)->excludes(d);
  s->excludes(d);
  CLI11_PARSE(app, argc, argv);
  std::signal(SIGINT, [](int) { interrupted = 1; });

  try {
    const auto scene = prdp::read_scene(path);
    auto refinement = prdp::train::prdp(scene);
    if (*k) refinement = prdp::train::constant(constant);
    if (*d) refinement = prdp::train::direct();
    if (*s) {
      long long start = 0, step = 0;
      if (std::sscanf(schedule.c_str(), "%lld:%lld", &start, &step) != 2)
        throw std::runtime_error("--schedule: expected START:STEP, got '" + schedule + "'");
      refinement = prdp::train::schedule(start, step, scene.solver.max_iter.expect_int());
    }
    const std::filesystem::path folder =
        std::filesystem::path(out.empty() ? "runs/" + scene.name + "-cpp" : out) / refinement.label;
    std::filesystem::create_directories(folder);
    std::string command;
    for (int i = 0; i < argc; ++i) command += (i ? " " : "") + std::string(argv[i]);

    std::printf("%s: %s, %s\n", scene.name.c_str(), refinement.label.c_str(), scene.title.c_str());
    for (int64_t seed = 0; seed < seeds; ++seed) {
      const auto curves = prdp::train::train(scene, refinement, seed, [&](int64_t done, double metric, int64_t max_iter) {
        if (interrupted) throw Interrupted{};
        if (done % 10 == 0 || done == 1)
          std::printf("seed %ld  interval %4ld  metric %.4e  K %ld\n", seed, done, metric, max_iter);
      });
      const auto file = folder / ("seed_" + std::to_string(seed) + ".json");
      write_whole(file, record(scene, refinement.label, seed, command, curves).dump(1));
      std::printf("seed %ld  final metric %.4e  written to %s\n", seed, curves.metric.back(), file.c_str());
    }
  } catch (const Interrupted&) {
    std::fprintf(stderr, "interrupted; finished seeds are kept\n");
    return 130;
  } catch (const c10::Error& error) {
    std::fprintf(stderr, "prdp_train: %s\n", error.what_without_backtrace());
    return 2;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "prdp_train: %s\n", error.what());
    return 2;
  }
  return 0;
}
