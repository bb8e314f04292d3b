"""Outputs that are mount points, as `docker -v` makes them, in a mount namespace of their own."""

import os
import shlex
import shutil
import subprocess
import sys
import time

import pytest
from flat import list_files
from maps import ENDLESS, QUICK
from result_contents import FILES

STILLMAP = shlex.join([sys.executable, "-m", "stillmap"])


def _can_mount() -> bool:
    if shutil.which("unshare") is None:
        return False
    mount = "mount -t tmpfs none /mnt"
    words = ["unshare", "--map-root-user", "--mount", "sh", "-c", mount]
    return subprocess.run(words, capture_output=True).returncode == 0


pytestmark = pytest.mark.skipif(not _can_mount(), reason="mounting is not permitted here")


@pytest.fixture
def mounted(tmp_path):
    """Runs a script with `$S` for stillmap, in a folder with `disk` bound to `out`."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").mkdir()

    def run(script: str, **variables: object) -> subprocess.CompletedProcess[str]:
        text = f"set -e; mount --bind disk out; S={shlex.quote(STILLMAP)}; {script}"
        return subprocess.run(
            ["unshare", "--map-root-user", "--mount", "sh", "-c", text],
            cwd=tmp_path,
            env={**os.environ, **{key: str(value) for key, value in variables.items()}},
            capture_output=True,
            text=True,
            timeout=100,
        )

    return run


def test_map_into_a_mount_point(mounted, room, tmp_path, nothing_left):
    quick = shlex.join(QUICK)
    done = mounted(f"$S map $IN -o out --quiet {quick}", IN=room)
    assert (done.returncode, done.stderr) == (0, "")
    assert list_files(tmp_path / "disk") >= FILES
    assert not [name for name in os.listdir(tmp_path / "disk") if name.startswith(".")]
    nothing_left("disk", "out")
    done = mounted(f"$S map $IN -o out --quiet {quick}", IN=room)
    assert done.returncode == 2
    assert "already holds something" in done.stderr
    (tmp_path / "disk" / "old.txt").write_text("of the earlier result")
    done = mounted(f"$S map $IN -o out --quiet --overwrite {quick}", IN=room)
    assert (done.returncode, done.stderr) == (0, "")
    assert list_files(tmp_path / "disk") >= FILES
    assert not (tmp_path / "disk" / "old.txt").exists()


@pytest.mark.slow
def test_killed_in_a_mount_point_and_resumed(mounted, hall, tmp_path, nothing_left):
    """Checkpoints lie inside: beside, in a container, they would go with it."""
    words = "--set em.max_iterations=4 --quiet"
    endless = shlex.join(ENDLESS)
    script = f"$S map $IN -o out --quiet {endless} & while ! ls out/.stillmap.resume/iteration-*"
    done = mounted(f"{script} 2>/dev/null; do sleep 0.05; done; kill -9 $!", IN=hall)
    assert done.returncode == 0, done.stderr
    assert os.listdir(tmp_path / "disk") == [".stillmap.resume"]
    time.sleep(0.1)
    shutil.rmtree(tmp_path / "disk/.stillmap.resume/new.part", ignore_errors=True)
    done = mounted(f"$S map $IN -o out {words} {endless} --set em.max_iterations=4", IN=hall)
    assert (done.returncode, done.stderr) == (0, "")
    assert list_files(tmp_path / "disk") >= FILES
    nothing_left("disk", "out")
