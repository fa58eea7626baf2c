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
  /// What was wrong with files that the last read() passed over, in a sentence; empty where nothing was.
  const std::string& notice() const { return notice_; }
  /// Raises that ValueError: for a state that its trainer cannot make sense of.
  [[noreturn]] void refuse() const;
  /// Raises ValueError for a state of more intervals than the training is to have.
  void check_length(int64_t done, int64_t intervals) const;
  /// Removes both files, where they are there. Raises ValueError where one cannot be removed.
  void remove() const;
  /// Removes them if they are older than the record of their training: a kill came between the two.
  void remove_before(const std::filesystem::path& record) const;

 private:
  using Clock = std::chrono::steady_clock;

  std::filesystem::path path_, before_;
  std::string settings_;
  std::chrono::duration<double> pause_;
  Clock::time_point last_ = Clock::now();
  std::string notice_;
};

}  // namespace prdp
