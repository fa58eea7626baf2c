#!/bin/sh
# Finds the header-only C++ libraries, or installs Debian's packages of them.
set -eu

missing=""
need() { # need HEADER PACKAGE
  for prefix in /usr/include /usr/local/include ${CPATH:+$(echo "$CPATH" | tr ':' ' ')}; do
    [ -e "$prefix/$1" ] && return 0
  done
  missing="$missing $2"
}

need gtest/gtest.h libgtest-dev
need toml++/toml.h libtomlplusplus-dev
need nlohmann/json.hpp nlohmann-json3-dev
need CLI/CLI.hpp libcli11-dev
[ -z "$missing" ] && exit 0

install="apt-get install -y --no-install-recommends$missing"
if command -v apt-get >/dev/null && [ "$(id -u)" = 0 ]; then
  apt-get update -qq
  DEBIAN_FRONTEND=noninteractive $install -qq >/dev/null
elif command -v apt-get >/dev/null && sudo -n true 2>/dev/null; then
  sudo apt-get update -qq
  sudo DEBIAN_FRONTEND=noninteractive $install -qq >/dev/null
else
  echo "prdp: headers of these Debian packages are missing and cannot be installed from here:$missing; install them, for example with: sudo $install" >&2
  exit 1
fi
