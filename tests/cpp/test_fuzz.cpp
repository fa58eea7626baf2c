#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <random>
#include <sstream>

#include "../fuzz/targets.h"
#include "prdp/autograd/linear_solve.h"
#include "prdp/operators/operator.h"
#include "prdp_experiments/files/record_keys.h"
#include "prdp_experiments/files/seal.h"
#include "prdp_experiments/scenes/scene.h"
#include "prdp_experiments/training/progress.h"

/// A short run of what `make fuzz` does at length: the corpus, and copies of it with bytes changed, moved or left out.
/// A fault ends the process, or throws what the target does not let pass.
namespace {

constexpr int kCopies = 200;  // of each file

/// The scenes of the project are the corpus of scenes.
std::filesystem::path corpus(const std::string& target) {
  return target == "scene" ? std::filesystem::path(PRDP_SCENES) : std::filesystem::path(PRDP_CORPUS) / target;
}

std::string read(const std::filesystem::path& path) {
  std::ostringstream text;
  text << std::ifstream(path, std::ios::binary).rdbuf();
  return text.str();
}

std::string changed(std::string text, std::mt19937& dice) {
  for (auto changes = 1 + dice() % 4; changes > 0 && !text.empty(); --changes) {
    const auto at = dice() % text.size(), count = 1 + dice() % 8;
    switch (dice() % 5) {
      case 0: text[at] = static_cast<char>(dice()); break;
      case 1: text.erase(at, count); break;
      case 2: text.insert(at, text.substr(dice() % text.size(), count)); break;
      case 3: text[at] ^= static_cast<char>(1 << dice() % 8); break;
      default: text.resize(at); break;
    }
  }
  return text;
}

TEST(Fuzz, TheCorpusAndChangedCopiesOfItAreReadOrRefused) {
  std::mt19937 dice(0);
  for (const auto& target : prdp_fuzz::targets()) {
    EXPECT_NO_THROW(target.run(""));
    int files = 0;
    for (const auto& entry : std::filesystem::directory_iterator(corpus(target.name))) {
      SCOPED_TRACE(entry.path());
      const auto text = read(entry.path());
      EXPECT_NO_THROW(target.run(text));
      for (int i = 0; i < kCopies; ++i) EXPECT_NO_THROW(target.run(changed(text, dice)));
      ++files;
    }
    EXPECT_GT(files, 1) << target.name;
  }
}

/// Where nothing in the corpus were read to its end, no changed copy would be, either.
TEST(Fuzz, TheCorpusHoldsFilesThatAreRead) {
  const auto content = [](const char* name) { return read(corpus("files") / name).substr(1); };
  EXPECT_EQ(prdp::unpack(content("tensors")).size(), 1);
  for (const auto* name : {"weights", "weights_of_dict"}) EXPECT_EQ(prdp::unpack(content(name)).size(), 4) << name;
  EXPECT_NO_THROW(prdp::check_training(prdp::parse_shallow(prdp::seal_record(content("training")))));
  prdp::Saved progress(prdp::unpack(content("progress")));
  EXPECT_EQ(prdp::train::load_progress(progress, 1).done(), 1);
  EXPECT_NO_THROW(progress.finish());
}

/// What fuzzing has found.
TEST(Fuzz, AScenesNameOfATableOrItsNumbersMayHoldAnyLetter) {
  for (const auto* text : {"[(]\n", "[ (hysics]\n", "start = [3.0, 3.\xd0\x9b]\n", "a \xd0\x9b = 1\n"})
    EXPECT_THROW(prdp::parse_scene(text, "fuzz.toml"), c10::ValueError) << text;
}

TEST(Fuzz, AnOffsetOfAStencilIsAWholeNumber) {
  const auto coefficients = at::ones({1, 1, 4}, at::kDouble);
  for (const double offset : {double(NAN), double(INFINITY), -1e300, 0.5})
    EXPECT_THROW(prdp::make_operator({"stencil", {4}, {0.0, offset}, {coefficients}}), c10::ValueError) << offset;
  EXPECT_NO_THROW(prdp::make_operator({"stencil", {4}, {0.0, 1.0}, {coefficients}}));
}

TEST(Fuzz, AVectorOfAStencilHasAChannel) {
  const prdp::OperatorSpec a{"stencil", {4}, {0.0, 1.0}, {at::ones({1, 1, 4}, at::kDouble)}};
  for (const auto method : {prdp::Method::kJacobi, prdp::Method::kChebyshev})
    EXPECT_THROW(prdp::linear_solve(a, at::zeros({2, 0, 4}, at::kDouble), {{method, 3}}), c10::ValueError);
}

}  // namespace
