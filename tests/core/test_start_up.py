"""Modules that every command imports stay light: no NumPy."""

import subprocess
import sys

import pytest

# each takes a tenth of a second or more to load, or leads to what does
HEAVY = (
    *("gtsam", "jinja2", "matplotlib", "rosbags"),
    *("scipy.sparse", "scipy.spatial", "stillmap.mesh.build", "trimesh"),
)


def loaded(code, *arguments):
    """Which heavy modules are loaded after some code."""
    code = f"{code}; import sys; print([name for name in {HEAVY} if name in sys.modules])"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize("module", ["cli.map_run", "results.writer", "io", "tracking"])
def test_heavy_modules_are_loaded_on_demand(module):
    assert loaded(f"import stillmap.{module}") == "[]"


def test_a_small_job_needs_few_of_them(tmp_path):
    recording, out = tmp_path / "sim", tmp_path / "out"
    simulate = "from stillmap.cli.main import main; import sys; main(sys.argv[1:])"
    scene = ("corridor-empty", "--scans", 12, "-o", recording, "--quiet")
    loaded(simulate, "simulate", *scene)
    found = loaded(simulate, "map", recording, "-o", out, "--quiet", "--set", "threads=1")
    assert (out / "report.html").is_file()
    assert found == "['jinja2']"
