#!/bin/sh
# system-packages.sh [HEADER ...]: installs Debian's packages of the header-only C++ libraries that the compiler does not
# find: all that the project takes, or those named. HEADERS names a folder where it looks as well.
set -eu

compiler=${CXX:-c++}
command -v "$compiler" >/dev/null || { echo "prdp: there is no C++ compiler $compiler; install one, for example with: apt-get install g++" >&2; exit 1; }

missing=""
for known in gtest/gtest.h=libgtest-dev toml++/toml.h=libtomlplusplus-dev nlohmann/json.hpp=nlohmann-json3-dev CLI/CLI.hpp=libcli11-dev; do
  header=${known%=*}
  case " ${*:-$header} " in *" $header "*) ;; *) continue ;; esac
  echo "#include <$header>" | "$compiler" -std=c++20 -x c++ ${HEADERS:+-I "$HEADERS"} -E - >/dev/null 2>&1 || missing="$missing ${known#*=}"
done
[ -z "$missing" ] && exit 0

as_root() {
  if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}
if command -v apt-get >/dev/null && as_root apt-get update -qq &&
  as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends -qq $missing >/dev/null; then
  exit 0
fi
echo "prdp: headers of these Debian packages are missing and cannot be installed from here:$missing; install them, for example with: sudo apt-get install$missing" >&2
exit 1
