#pragma once
#include <chrono>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>

namespace prdp {

/// The file that keeps a training while it runs: every trainer puts its own state into it, as bytes. It also holds
/// the settings that the state belongs to, and the fingerprint of both (seal.h). The one before is kept as well, under
/// the same name with ".before" behind it.
class Checkpoint {
 public:
  /// `settings`: one line, all that the state depends on. A checkpoint is due every ten seconds, or every
  /// $PRDP_CHECKPOINT_SECONDS. Raises ValueError where that is no number >= 0.
  Checkpoint(std::filesystem::path path, std::string settings);

  /// True once so much time has passed since the last one, or since the start.
  bool due() const;
  /// Replaces the file, whole or not at all. Raises ValueError, naming it, where it cannot be written; the last one is
  /// then still there.
  void write(std::string state);
  /// The state last written; that of the one before where the last is damaged, missing or of other settings; none
  /// where there is neither. Raises ValueError, naming the file and the remedy, for a damaged one without another.
  std::optional<std::string> read();
  /// The state of the one before, for a trainer that can make no sense of what read() has returned. Raises that
  /// ValueError where there is none, or read() has returned it already.
  std::string read_before();
  /// Raises that ValueError: where the trainer can make no sense of the one before either.
  [[noreturn]] void refuse() const;
  /// What was wrong with files that the last call of the two passed over, in a sentence; empty where nothing was.
  const std::string& notice() const { return notice_; }
  /// Raises ValueError for a state of more intervals than the training is to have.
  void check_length(int64_t done, int64_t intervals) const;
  /// Removes both files, where they are there. Raises ValueError where one cannot be removed.
  void remove() const;
  /// Removes them if they are older than the record of their training: a kill came between the two.
  void remove_before(const std::filesystem::path& record) const;

 private:
  using Clock = std::chrono::steady_clock;

  std::optional<std::string> found_in(const std::filesystem::path& path);
  void note_damage();

  std::filesystem::path path_, before_;
  std::string settings_;
  std::chrono::duration<double> pause_;
  Clock::time_point last_ = Clock::now();
  std::string notice_;
  bool found_before_ = false;  // that read() has returned the state of the one before
};

}  // namespace prdp
