#include "targets.h"

#include <sys/mman.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>

#include "prdp/autograd/linear_solve.h"
#include "prdp/operators/operator.h"
#include "prdp/solvers/methods.h"
#include "prdp_experiments/files/checkpoint.h"
#include "prdp_experiments/files/record.h"
#include "prdp_experiments/files/seal.h"
#include "prdp_experiments/networks/mlp.h"
#include "prdp_experiments/networks/weights.h"
#include "prdp_experiments/scenes/scene.h"
#include "prdp_experiments/training/progress.h"

namespace prdp_fuzz {

namespace {

/// Calls f; errors that a user's argument or file deserves are what is wanted.
template <class F>
void refused_or_done(const F& f) {
  try {
    f();
  } catch (const c10::ValueError&) {
  } catch (const c10::TypeError&) {
  } catch (const c10::LinAlgError&) {
  }
}

/// Values that the bytes choose; zeros when there are none left.
class Bytes {
 public:
  explicit Bytes(std::string_view left) : left_(left) {}

  template <class T>
  T take() {
    T value{};
    const auto n = std::min(sizeof value, left_.size());
    std::memcpy(&value, left_.data(), n);
    left_.remove_prefix(n);
    return value;
  }
  int64_t below(int64_t end) { return take<uint8_t>() % end; }
  template <class T>
  const T& one_of(const std::vector<T>& all) {
    return all[static_cast<size_t>(below(static_cast<int64_t>(all.size())))];
  }
  /// Mostly small, sometimes anything.
  int64_t number() {
    const auto kind = below(8);
    return kind == 0 ? take<int64_t>() : take<int8_t>() / (kind < 4 ? 16 : 1);
  }
  double real() { return below(4) == 0 ? take<double>() : take<int8_t>() / 16.0; }
  std::string_view rest() const { return left_; }

 private:
  std::string_view left_;
};

void scene(std::string_view text) {
  refused_or_done([&] { prdp::parse_scene(std::string(text), "fuzz.toml"); });
}

/// A file in memory, rewritten for each input.
class File {
 public:
  explicit File(const char* name) : file_(memfd_create(name, 0)) {}
  std::string holding(std::string_view content) const {
    if (ftruncate(file_, 0) != 0 || pwrite(file_, content.data(), content.size(), 0) < 0) std::abort();
    return "/proc/self/fd/" + std::to_string(file_);
  }

 private:
  int file_;
};

void files(std::string_view input) {
  static const File file("fuzz");
  static prdp::MLP network(3, std::vector<int64_t>{2});
  Bytes bytes(input);
  const auto kind = bytes.below(8);
  const std::string content(bytes.rest());
  refused_or_done([&] {
    if (kind == 0) prdp::read_record(file.holding(content));
    if (kind == 1) prdp::open_sealed(file.holding(content), "checkpoint");
    if (kind == 2) prdp::unpack(content);
    if (kind == 3) prdp::unpack_weights(content, *network);
    if (kind == 4) prdp::read_record(file.holding(prdp::seal_record(content)));
    if (kind == 5) prdp::Checkpoint(file.holding(content), "settings").find();
    if (kind == 6) prdp::read_training(file.holding(prdp::seal_record(content)));
    if (kind == 7) {
      prdp::Saved saved(prdp::unpack(content));
      prdp::train::load_progress(saved, 1);
      saved.finish();
    }
  });
}

at::Tensor tensor(Bytes& bytes, bool indices) {
  std::vector<int64_t> sizes;
  for (auto axes = bytes.below(5); axes > 0; --axes) sizes.push_back(bytes.below(5));
  if (bytes.below(16) == 0) return at::zeros(sizes, bytes.below(2) ? at::kBool : at::kHalf);
  auto t = at::zeros(sizes, indices ? at::kLong : bytes.below(2) ? at::kFloat : at::kDouble);
  if (indices) {
    for (int64_t i = 0; i < t.numel(); ++i) t.mutable_data_ptr<int64_t>()[i] = bytes.number();
  } else {
    std::vector<double> values(static_cast<size_t>(t.numel()));
    for (auto& value : values) value = bytes.real();
    t.copy_(at::tensor(values, at::kDouble).view(sizes));
  }
  return bytes.below(4) == 0 && t.dim() >= 2 ? t.transpose(-1, -2) : t;
}

void operators(std::string_view input) {
  Bytes bytes(input);
  prdp::OperatorSpec spec;
  spec.kind =
      bytes.one_of<std::string>({"csr", "stencil", "dense", "heat", "poisson", "burgers", "navier_stokes", "?"});
  for (auto n = bytes.below(4); n > 0; --n) spec.shape.push_back(bytes.below(8) ? bytes.below(6) : bytes.number());
  for (auto n = bytes.below(10); n > 0; --n)
    spec.parameters.push_back(bytes.below(4) ? static_cast<double>(bytes.below(5) - 2) : bytes.real());
  for (auto n = bytes.below(4); n > 0; --n) spec.tensors.push_back(tensor(bytes, bytes.below(2)));
  // Most descriptions that are not of the right form would be refused at once.
  if (spec.kind == "csr" && bytes.below(8)) {
    const int64_t n = bytes.below(5), stored = bytes.below(8);
    auto crow = at::zeros({n + 1}, at::kLong), col = at::zeros({stored}, at::kLong);
    for (int64_t i = 1; i <= n; ++i) crow[i] = bytes.below(16) ? std::min(stored, 2 * i) : bytes.number();
    if (bytes.below(16)) crow[n] = stored;
    for (int64_t i = 0; i < stored; ++i)
      col[i] = bytes.below(16) ? bytes.below(std::max<int64_t>(n, 1)) : bytes.number();
    spec.tensors = {crow, col, at::rand({stored}, at::kDouble)};
    spec.shape.clear();
    spec.parameters.clear();
  }
  spec.transposed = bytes.below(2);
  const auto b = tensor(bytes, false);
  const auto method = prdp::kTraits[static_cast<size_t>(bytes.below(prdp::kTraits.size()))].method;
  prdp::SolveOptions options{
      {method, std::min<int64_t>(bytes.number(), 30), bytes.real(), std::min<int64_t>(bytes.number(), 30)}};
  options.on_failure = prdp::OnFailure::kReturn;
  refused_or_done([&] { prdp::linear_solve(spec, b, options); });
}

}  // namespace

const std::vector<Target>& targets() {
  static const std::vector<Target> all{{"scene", scene}, {"files", files}, {"operators", operators}};
  return all;
}

}  // namespace prdp_fuzz
