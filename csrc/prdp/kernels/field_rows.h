#pragma once
#include "prdp/kernels/vector.h"

namespace prdp::kernels {

/// One sample of several fields in padded rows, which need no zeros between them.
template <class T>
class FieldRows {
 public:
  using Scalar = T;

  FieldRows(int64_t fields, int64_t rows, int64_t nx)
      : fields_(fields), rows_(rows), nx_(nx), row_(round_up_to_lanes<T>(nx)) {}
  int64_t unknowns() const { return fields_ * rows_ * nx_; }
  int64_t length() const { return fields_ * field(); }
  int64_t halo() const { return kLanes<T>; }

  /// dst = scale·src, from a contiguous sample into the padded layout; and back.
  void load(const T* src, T scale, T* dst) const { loops_.copy_rows(scale, src, nx_, dst, row_, fields_ * rows_, nx_); }
  void store(const T* src, T scale, T* dst) const {
    loops_.copy_rows(scale, src, row_, dst, nx_, fields_ * rows_, nx_);
  }

 protected:
  int64_t field() const { return rows_ * row_; }  // padded length of one

  const Loops<T>& loops_ = kernels::loops<T>();
  int64_t fields_, rows_, nx_, row_;
};

}  // namespace prdp::kernels
