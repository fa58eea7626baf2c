#pragma once
#include "prdp_experiments/data/data.h"

namespace prdp {

/// The scene's data from its file in the folder $PRDP_CACHE, else ~/.cache/prdp_torch; where there is no
/// such file, `make` is called and the file written, whole or not at all. The file's name is that of the
/// settings the data depend on. Raises ValueError, naming the file and the remedy, for a folder that cannot
/// be made and for a file that is damaged or holds something else.
Dataset cached_dataset(const Scene& scene, const std::function<Dataset()>& make);

}  // namespace prdp
