#!/bin/sh
# Says what this machine lacks to build stillmap, one line for each thing, and what installs it.
# Usage: tools/require.sh PYTHON
set -u

python=$1
missing=0

lacks() {
  echo "stillmap: $1" >&2
  missing=1
}

python_can() {
  "$python" -c "$1" >/dev/null 2>&1
}

if ! command -v "$python" >/dev/null 2>&1; then
  lacks "$python is missing: apt install python3 python3-venv python3-dev"
elif ! python_can 'import sys; sys.exit(sys.version_info < (3, 11))'; then
  lacks "$("$python" --version 2>&1) is too old, 3.11 or newer is needed: make PYTHON=python3.11"
else
  python_can 'import ensurepip, venv' ||
    lacks "$python cannot make virtual environments: apt install python3-venv"
  python_can 'import pathlib, sysconfig; (pathlib.Path(sysconfig.get_path("include")) / "Python.h").stat()' ||
    lacks "the headers of $python are missing: apt install python3-dev"
fi

compiler=${CXX:-g++}
if ! command -v "${compiler%% *}" >/dev/null 2>&1; then
  lacks "${compiler%% *} is missing: apt install g++"
elif ! printf '#include <optional>\nint main() { return std::optional<int>(0).value(); }\n' |
  $compiler -std=c++17 -x c++ -fsyntax-only - >/dev/null 2>&1; then
  lacks "$compiler cannot compile C++17: apt install g++"
fi

exit $missing
