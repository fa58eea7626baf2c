#pragma once
#include <ATen/ATen.h>

#include "prdp/gpu/device/arguments.h"
#include "prdp/gpu/part_of.h"

namespace prdp::gpu {

/// Global memory of a launch, in one tensor: barrier counters and partial sums, if a team has several blocks; then the
/// kernel's own workspace.
class TeamMemory {
 public:
  TeamMemory() = default;
  /// `own`: bytes of the kernel.
  TeamMemory(int64_t blocks, int64_t teams, const at::TensorOptions& options, int64_t own = 0)
      : arrived_(blocks > 1 ? kArrivedOfTeam * int64_t{sizeof(unsigned)} * teams : 0),
        parts_(blocks > 1 ? kPartsOfBlock * int64_t{sizeof(double)} * blocks * teams : 0) {
    if (arrived_ + own == 0) return;
    memory_ = at::empty({arrived_ + parts_ + own}, options.dtype(at::kByte));
    if (arrived_ > 0) part_of(memory_, 0, arrived_, at::kByte).zero_();
  }
  /// Into the arguments of a kernel.
  template <class Arguments>
  void put_into(Arguments& arguments) const {
    if (arrived_ == 0) return;
    arguments.arrived = place<unsigned>(0);
    arguments.parts = place<double>(arrived_);
  }
  /// The kernel's own workspace.
  template <class T>
  T* own() const {
    return memory_.defined() ? place<T>(arrived_ + parts_) : nullptr;
  }

 private:
  template <class T>
  T* place(int64_t byte) const {
    return reinterpret_cast<T*>(static_cast<char*>(memory_.mutable_data_ptr()) + byte);
  }

  at::Tensor memory_{};
  int64_t arrived_ = 0, parts_ = 0;  // bytes
};

}  // namespace prdp::gpu
