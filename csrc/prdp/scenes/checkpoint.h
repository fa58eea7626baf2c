#pragma once
#include <chrono>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>

namespace prdp {

/// The file that keeps a training while it runs: every trainer puts its own state into it, as bytes. It also holds
/// the settings that the state belongs to, and the fingerprint of both (seal.h).
class Checkpoint {
 public:
  /// `settings`: one line, all that the state depends on. A checkpoint is due every ten seconds, or every
  /// $PRDP_CHECKPOINT_SECONDS. Raises ValueError where that is no number >= 0.
  Checkpoint(std::filesystem::path path, std::string settings);

  /// True once so much time has passed since the last one, or since the start.
  bool due() const;
  /// Replaces the file, whole or not at all. Raises ValueError, naming it, where it cannot be written.
  void write(std::string state);
  /// The state last written; none where there is no file, or one of other settings. Raises ValueError,
  /// naming the file and the remedy, for one that is damaged.
  std::optional<std::string> read() const;
  /// Raises that ValueError: for a state that its trainer cannot make sense of.
  [[noreturn]] void refuse() const;
  /// Raises ValueError for a state of more intervals than the training is to have.
  void check_length(int64_t done, int64_t intervals) const;
  /// Removes the file, if there is one. Raises ValueError where it cannot be removed.
  void remove() const;

 private:
  using Clock = std::chrono::steady_clock;

  std::filesystem::path path_;
  std::string settings_;
  std::chrono::duration<double> pause_;
  Clock::time_point last_ = Clock::now();
};

}  // namespace prdp
