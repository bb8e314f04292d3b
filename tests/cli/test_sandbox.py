"""The main job where hardly anything is permitted: as in a strict container."""

import os
import shlex
import shutil
import subprocess
import sys

import pytest
from flat import list_files
from maps import QUICK
from result_contents import FILES

import stillmap

# only $BOX/out and $BOX/tmp can be written; then another user, without a home or a name
_SCRIPT = """
set -e
mount --bind "$BOX/out" "$BOX/out"
mount -t tmpfs none "$BOX/tmp"
mount -o remount,ro,bind /
cut -d ' ' -f 2 /proc/self/mounts | while read -r place; do
  case $place in
    / | /proc* | /sys* | /dev* | "$BOX"/*) ;;
    *) mount -o remount,ro,bind "$place" 2>/dev/null || true ;;
  esac
done
if touch "$BOX/beside" 2>/dev/null; then echo "beside can be written" >&2; exit 99; fi
exec unshare --user --map-user=12345 env -i LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 \
  PATH=/usr/bin:/bin TMPDIR="$BOX/tmp" PYTHONPATH="$PYTHONPATH" PYTHONDONTWRITEBYTECODE=1 \
  prlimit --as=2147483648 {command}
"""
_BOX = ("unshare", "--map-root-user", "--mount", "--net")


def _is_permitted() -> bool:
    if not all(map(shutil.which, ("unshare", "prlimit"))):
        return False
    test = "mount -t tmpfs none /mnt && unshare --user --map-user=12345 true"
    return subprocess.run([*_BOX, "sh", "-c", test], capture_output=True).returncode == 0


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not _is_permitted(), reason="namespaces are not permitted here"),
]


@pytest.fixture
def boxed(tmp_path):
    """Runs a command of Python in the box; its output folder is `tmp_path / "out"`."""

    def run(*words: object) -> subprocess.CompletedProcess[str]:
        for name in ("out", "tmp"):
            (tmp_path / name).mkdir(exist_ok=True)
        command = shlex.join([sys.executable, *map(str, words)])
        source = os.path.dirname(os.path.dirname(stillmap.__file__))
        return subprocess.run(
            [*_BOX, "sh", "-c", _SCRIPT.format(command=command)],
            env={**os.environ, "BOX": str(tmp_path), "PYTHONPATH": source},
            capture_output=True,
            text=True,
            timeout=300,
        )

    return run


def test_main_job(boxed, room, tmp_path):
    done = boxed("-m", "stillmap", "map", room, "-o", tmp_path / "out", *QUICK)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert list_files(tmp_path / "out") >= FILES
    assert sorted(os.listdir(tmp_path)) == ["out", "tmp"]
    assert not [one for one in os.listdir(tmp_path / "out") if one.startswith(".")]
    assert os.listdir(tmp_path / "tmp") == []
