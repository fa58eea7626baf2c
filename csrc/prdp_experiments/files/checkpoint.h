#pragma once
#include <chrono>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <string>
#include <vector>

#include "prdp_experiments/files/saved.h"

namespace prdp {

/// The file that keeps a training while it runs: every trainer puts its own state into it, as named tensors. It also
/// holds the settings that the state belongs to, and the fingerprint of both (seal.h). The one before is kept as well,
/// under the same name with ".before" behind it.
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

  /// One of the two files, as it was found: its state, or what is wrong with it.
  struct Found {
    std::filesystem::path path;
    std::string state, wrong;
  };
  /// Those that are there, the last one first, without those of other settings, which it notes. Raises ValueError,
  /// naming the file, what is wrong and the remedy, if there are only damaged ones.
  std::vector<Found> find();
  /// Takes what a trainer needs out of the tensors. Raises ValueError where they are not of its training.
  using Load = std::function<void(Saved&)>;
  /// Loads the first that load() accepts, and notes what was wrong with the one before it. A state that load() refuses
  /// may have been taken in part. Returns false if nothing was found, and raises that ValueError if it accepts none.
  bool restore(const std::vector<Found>& found, const Load& load);
  /// What was wrong with files that the two have passed over, in a sentence; empty where nothing was.
  const std::string& notice() const { return notice_; }

  /// Raises ValueError for a state of more intervals than the training is to have.
  void check_length(int64_t done, int64_t intervals) const;
  /// Removes both files, where they are there. Raises ValueError where one cannot be removed.
  void remove() const;
  /// Removes them if they are older than the record of their training: a kill came between the two. Those of another
  /// training stay, as a record that was copied or touched is newer, too.
  void remove_before(const std::filesystem::path& record) const;
  /// Raises ValueError for a state of other settings, or of another version, that is not older than the record: it
  /// would be overwritten.
  void refuse_other(const std::filesystem::path& record) const;
  /// Raises ValueError if there is a state to go on from that is not older than the record: a training from the start
  /// would lose it.
  void refuse_to_lose(const std::filesystem::path& record);

 private:
  using Clock = std::chrono::steady_clock;

  void find_in(const std::filesystem::path& path, std::vector<Found>& found);
  bool is_of_another(const std::filesystem::path& path) const;

  std::filesystem::path path_, before_;
  std::string settings_;
  std::chrono::duration<double> pause_;
  Clock::time_point last_ = Clock::now();
  std::string notice_;
  bool last_is_good_ = true;  // and becomes the one before
};

}  // namespace prdp
