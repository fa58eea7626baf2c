#pragma once
#include <map>
#include <string>
#include <string_view>

namespace prdp {

/// The files in a zip archive by name, as views of its bytes. Files must be stored as torch stores them: whole and not
/// compressed. Raises ValueError for other bytes, and where the files together are larger than the archive.
/// torch's own reader believes the sizes that an archive names, and asks for as much memory.
/// Source: PKWARE, APPNOTE.TXT 6.3, sections 4.3 to 4.5.
std::map<std::string, std::string_view> archived_files(std::string_view archive);

}  // namespace prdp
