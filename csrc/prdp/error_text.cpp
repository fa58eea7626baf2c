#include "prdp/error_text.h"

#include <algorithm>
#include <atomic>
#include <iomanip>
#include <sstream>

namespace prdp {

namespace {
std::atomic<bool> speaks_python = false;
}

std::string sentence(std::string_view what) {
  what = what.substr(0, what.find("\nException raised from"));
  if (what == "std::bad_alloc") return "out of memory";
  constexpr std::string_view kTried = "you tried to allocate ";
  if (const auto at = what.find(kTried); at != what.npos) {
    const auto size = what.substr(at + kTried.size());
    return "out of memory: cannot allocate " + std::string(size.substr(0, size.find('.')));
  }
  what = what.substr(0, what.find_last_not_of("\n ") + 1);
  std::string line(what);
  std::replace(line.begin(), line.end(), '\n', ' ');
  return line;
}

std::string three_digits(double x) {
  std::ostringstream text;
  text << std::setprecision(3) << x;
  return text.str();
}

std::string dtype_name(c10::ScalarType dtype) { return std::string(c10::getDtypeNames(dtype).first); }

std::string as_tuple(c10::ArrayRef<int64_t> numbers) {
  std::ostringstream text;
  for (size_t i = 0; i < numbers.size(); ++i) text << (i ? ", " : "(") << numbers[i];
  text << (numbers.size() == 1 ? ",)" : ")");
  return text.str();
}

void speak_python() { speaks_python = true; }

const char* in_language(const char* python, const char* cpp) { return speaks_python ? python : cpp; }

}  // namespace prdp
