#pragma once
#include <string>
#include <string_view>

namespace prdp {

/// An error's words as the commands print them: one line, without the places in torch's source that it came from.
std::string sentence(std::string_view what);

}  // namespace prdp
