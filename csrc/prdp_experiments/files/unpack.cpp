#include <ATen/ops/empty.h>

#include <cstring>
#include <deque>
#include <unordered_map>
#include <variant>

#include "prdp_experiments/files/archive.h"
#include "prdp_experiments/files/tensor_map.h"

namespace prdp {

namespace {

using Files = std::map<std::string, std::string_view>;

/// A class or a function that a pickle names.
struct Name {
  std::string_view module, name;
  bool operator==(const Name&) const = default;
};
struct Items;
/// What a pickle makes. None, True and False are the first one; a storage is a tensor of one axis.
using Value = std::variant<std::monostate, int64_t, std::string_view, Name, Items*, at::Tensor>;
/// What a tuple, a list or a dict holds: of a dict, its keys and values in turn.
struct Items : std::vector<Value> {};

at::ScalarType dtype_of(const Name& storage) {
  static const std::unordered_map<std::string_view, at::ScalarType> known{{"DoubleStorage", at::kDouble},
                                                                          {"FloatStorage", at::kFloat},
                                                                          {"HalfStorage", at::kHalf},
                                                                          {"BFloat16Storage", at::kBFloat16},
                                                                          {"LongStorage", at::kLong},
                                                                          {"IntStorage", at::kInt},
                                                                          {"ShortStorage", at::kShort},
                                                                          {"CharStorage", at::kChar},
                                                                          {"ByteStorage", at::kByte},
                                                                          {"BoolStorage", at::kBool},
                                                                          {"ComplexFloatStorage", at::kComplexFloat},
                                                                          {"ComplexDoubleStorage", at::kComplexDouble}};
  return known.at(storage.name);
}

/// Runs a pickle of named tensors. It knows the instructions that torch writes for these, and three functions; nothing
/// that it makes is larger than the archive. torch's own unpickler believes the lengths in a pickle, and makes tensors
/// that reach beyond their storage.
/// Throws any exception for another pickle.
/// Source: Python, pickletools.py; torch/csrc/jit/serialization/pickler.cpp.
class Pickle {
 public:
  Pickle(const Files& files, std::string folder)
      : files_(files), folder_(std::move(folder)), left_(files.at(folder_ + "data.pkl")) {
    const auto order = files.find(folder_ + "byteorder");
    TORCH_CHECK_VALUE(order == files.end() || order->second == "little",
                      "pickle: of a machine with another byte order");
  }

  TensorMap run() {
    for (char instruction = take(1)[0]; instruction != '.'; instruction = take(1)[0]) follow(instruction);
    const auto& all = *std::get<Items*>(pop());
    TensorMap named;
    for (size_t i = 0; i < all.size(); i += 2)
      named.insert_or_assign(std::string(std::get<std::string_view>(all[i])), std::get<at::Tensor>(all.at(i + 1)));
    return named;
  }

 private:
  void follow(char instruction) {
    switch (instruction) {
      case '\x80': take(1); break;  // the version
      case 'N':
      case '\x88':
      case '\x89': push({}); break;
      case 'K': push(number<uint8_t>()); break;
      case 'M': push(number<uint16_t>()); break;
      case 'J': push(number<int32_t>()); break;
      case '\x8a': push(long_number()); break;
      case 'X': push(take(number<uint32_t>())); break;
      case 'c': push(name()); break;
      case '}':
      case ']':
      case ')': push(made({})); break;
      case '(': marks_.push_back(stack_.size()); break;
      case 't': push(made(popped(since_mark()))); break;
      case '\x85':
      case '\x86':
      case '\x87': push(made(popped(static_cast<uint8_t>(instruction) - 0x84u))); break;
      case 'a': add(popped(1)); break;
      case 's': add(popped(2)); break;
      case 'e':
      case 'u': add(popped(since_mark())); break;
      case 'b': pop(); break;  // attributes, of which a dict of tensors needs none
      case 'q': memo_[number<uint8_t>()] = top(); break;
      case 'r': memo_[number<uint32_t>()] = top(); break;
      case 'h': push(memo_.at(number<uint8_t>())); break;
      case 'j': push(memo_.at(number<uint32_t>())); break;
      case 'Q': push(storage(*std::get<Items*>(pop()))); break;
      case 'R': push(call()); break;
      default: TORCH_CHECK_VALUE(false, "pickle: an unknown instruction");
    }
  }

  std::string_view take(size_t count) {
    TORCH_CHECK_VALUE(count <= left_.size(), "pickle: its end is missing");
    const auto taken = left_.substr(0, count);
    left_.remove_prefix(count);
    return taken;
  }
  template <class T>
  T number() {
    T value;
    std::memcpy(&value, take(sizeof value).data(), sizeof value);
    return value;
  }
  int64_t long_number() {
    const auto bytes = take(number<uint8_t>());
    TORCH_CHECK_VALUE(bytes.size() <= 8, "pickle: a number of more than 64 bits");
    int64_t value = !bytes.empty() && bytes.back() < 0 ? -1 : 0;
    std::memcpy(&value, bytes.data(), bytes.size());
    return value;
  }
  std::string_view line() {
    const auto found = take(left_.find('\n') + 1);
    return found.substr(0, found.size() - 1);
  }
  Name name() {
    const auto module = line();
    return {module, line()};
  }

  void push(Value value) { stack_.push_back(std::move(value)); }
  const Value& top() const {
    TORCH_CHECK_VALUE(!stack_.empty(), "pickle: nothing is left");
    return stack_.back();
  }
  Value pop() { return popped(1)[0]; }
  Items popped(size_t count) {
    TORCH_CHECK_VALUE(count <= stack_.size(), "pickle: nothing is left");
    Items values;
    values.assign(stack_.end() - static_cast<std::ptrdiff_t>(count), stack_.end());
    stack_.resize(stack_.size() - count);
    return values;
  }
  size_t since_mark() {
    TORCH_CHECK_VALUE(!marks_.empty() && marks_.back() <= stack_.size(), "pickle: no mark is left");
    const auto mark = marks_.back();
    marks_.pop_back();
    return stack_.size() - mark;
  }
  Items* made(Items items) { return &made_.emplace_back(std::move(items)); }
  void add(const Items& more) {
    auto& items = *std::get<Items*>(top());
    items.insert(items.end(), more.begin(), more.end());
  }

  /// ("storage", class, file, device, length). Each file is read once.
  at::Tensor storage(const Items& said) {
    const auto dtype = dtype_of(std::get<Name>(said.at(1)));
    const std::string key(std::get<std::string_view>(said.at(2)));
    auto& storage = storages_[key];
    if (!storage.defined()) {
      const auto bytes = files_.at(folder_ + "data/" + key);
      const auto length = static_cast<int64_t>(bytes.size() / c10::elementSize(dtype));
      TORCH_CHECK_VALUE(std::get<int64_t>(said.at(4)) == length, "pickle: a storage of another length");
      storage = at::empty({length}, dtype);
      std::memcpy(storage.mutable_data_ptr(), bytes.data(), storage.nbytes());
    }
    TORCH_CHECK_VALUE(storage.scalar_type() == dtype, "pickle: a storage of two dtypes");
    return storage;
  }

  Value call() {
    const auto& given = *std::get<Items*>(pop());
    const auto function = std::get<Name>(pop());
    if (function == Name{"collections", "OrderedDict"} && given.empty()) return made({});
    if (function == Name{"torch._utils", "_rebuild_parameter"}) return given.at(0);
    TORCH_CHECK_VALUE((function == Name{"torch._utils", "_rebuild_tensor_v2"}), "pickle: an unknown function");
    const auto sizes = numbers(given.at(2)), strides = numbers(given.at(3));
    for (const auto size : sizes) TORCH_CHECK_VALUE(size >= 0, "pickle: a negative size");
    // as_strided refuses what reaches beyond the storage.
    return std::get<at::Tensor>(given.at(0)).as_strided(sizes, strides, std::get<int64_t>(given.at(1)));
  }
  static std::vector<int64_t> numbers(const Value& tuple) {
    std::vector<int64_t> numbers;
    for (const auto& value : *std::get<Items*>(tuple)) numbers.push_back(std::get<int64_t>(value));
    return numbers;
  }

  const Files& files_;
  const std::string folder_;
  std::string_view left_;  // of the pickle
  std::vector<Value> stack_;
  std::vector<size_t> marks_;
  std::unordered_map<uint32_t, Value> memo_;
  std::map<std::string, at::Tensor> storages_;
  std::deque<Items> made_;
};

}  // namespace

TensorMap unpack(std::string_view bytes) {
  constexpr std::string_view kPickle = "/data.pkl";
  try {
    const auto files = archived_files(bytes);
    for (const auto& [path, content] : files)
      if (path.ends_with(kPickle)) return Pickle(files, path.substr(0, path.size() - kPickle.size() + 1)).run();
  } catch (const std::exception&) {
  }
  TORCH_CHECK_VALUE(false, "expected named tensors");
}

}  // namespace prdp
