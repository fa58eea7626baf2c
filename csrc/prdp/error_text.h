#pragma once
#include <c10/core/ScalarType.h>
#include <c10/util/ArrayRef.h>

#include <cstdint>
#include <string>
#include <string_view>

namespace prdp {

/// An error's words as the commands print them: one line, without the places in torch's source that it came from.
std::string sentence(std::string_view what);

/// A number as messages give it: "1.23", "4e-05".
std::string three_digits(double x);

/// "float32", as PyTorch's users write it.
std::string dtype_name(c10::ScalarType dtype);

/// An index or an offset: "(0, -1)", or "(3,)" for one number.
std::string as_tuple(c10::ArrayRef<int64_t> numbers);

/// Messages name things as their reader writes them: as in C++ until this is called, then as in Python and scenes.
void speak_python();
/// One of the two names.
const char* in_language(const char* python, const char* cpp);

}  // namespace prdp
