#!/bin/sh
# cuda-packages.sh PYTHON FOLDER: makes an environment that sees the packages of PYTHON, and installs into it what
# `make cuda` needs and neither has, as requirements.txt pins it.
set -eu

python=$2/bin/python
[ -x "$python" ] || "$1" -m venv --without-pip "$2"
"$1" -c 'import site; print(*site.getsitepackages(), site.getusersitepackages(), sep="\n")' > "$(ls -d "$2"/lib/python*/site-packages)/prdp.pth"

missing=""
want() { # want PACKAGE
  missing="$missing $(grep "^$1==" requirements.txt)"
}
for module in numpy matplotlib jinja2 rich typer pytest hypothesis; do
  "$python" -c "import $module" 2>/dev/null || want "$module"
done
PATH=$2/bin:$(dirname "$(command -v "$1")"):$PATH
for command in cmake ninja; do
  command -v "$command" >/dev/null || want "$command"
done
[ -n "${HEADERS:-}" ] || "$python" -c "import cmeel" 2>/dev/null || want cmeel-eigen
[ -z "$missing" ] && exit 0
"$python" -m pip install --quiet --disable-pip-version-check $missing || {
  echo "prdp: these packages are missing and cannot be installed from here:$missing; install them into the environment of $1, or give HEADERS=folder for those of headers" >&2
  exit 1
}
