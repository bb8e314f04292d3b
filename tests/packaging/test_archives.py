"""Contents of source archive and wheel; the wheel works in a fresh environment."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
# prints what cannot be imported with the base dependencies alone, except for the viewer's server
IMPORT_ALL = """
import importlib, pkgutil, stillmap
for module in pkgutil.walk_packages(stillmap.__path__, "stillmap."):
    if module.name == "stillmap.__main__":
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        if error.name not in ("viser", "websockets") or "viewer" not in module.name:
            print(module.name, error.name)
"""
JUNK = re.compile(r"\.(so|pyc|egg-info)$|__pycache__|/(build|dist|demo|\.venv|\.ci|\.git\w*)(/|$)")

TEMPLATES = [str(path.relative_to(ROOT / "src")) for path in (ROOT / "src").rglob("*.j2")]


def run(*command, cwd):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sdist")
    run(sys.executable, "-m", "build", "--sdist", "--outdir", folder, ROOT, cwd=folder)
    (archive,) = folder.iterdir()
    return archive


@pytest.fixture(scope="module")
def wheel(sdist, tmp_path_factory):
    """Built in isolation from the archive, as pip does for a user."""
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", folder, sdist, cwd=folder)
    (archive,) = folder.iterdir()
    return archive


def test_source_archive_is_complete(sdist):
    with tarfile.open(sdist) as archive:
        names = [name.partition("/")[2] for name in archive.getnames()]
    assert [name for name in names if JUNK.search(f"/{name}")] == []
    for folder in ("src", "cpp", "tests"):
        sources = (ROOT / folder).rglob("*.[ch]pp" if folder == "cpp" else "*.py")
        assert {str(path.relative_to(ROOT)) for path in sources} <= set(names)
    assert {f"src/{name}" for name in TEMPLATES} <= set(names)
    top = {"CMakeLists.txt", "pyproject.toml", "Makefile", "LICENSE", "README.md", "CHANGELOG.md"}
    assert top <= set(names)


def test_wheel_holds_only_the_package(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert len(names) == len(set(names))
    info = "-".join(wheel.name.split("-")[:2]) + ".dist-info"
    assert {name.split("/")[0] for name in names} == {"stillmap", info}
    assert [name for name in names if name.endswith(".pyi")] == ["stillmap/_core.pyi"]
    assert len([name for name in names if name.endswith(".so")]) == 1
    assert {"stillmap/py.typed", *TEMPLATES} <= set(names)
    assert f"{info}/licenses/LICENSE" in names


def test_wheel_maps_in_a_fresh_environment(wheel, tmp_path):
    run(sys.executable, "-m", "venv", "venv", cwd=tmp_path)
    run("venv/bin/python", "-m", "pip", "install", wheel, cwd=tmp_path)
    assert run("venv/bin/python", "-c", IMPORT_ALL, cwd=tmp_path).split() == []
    simulate = ("simulate", "hall", "-o", "sim", "--scans", "60")
    run("venv/bin/stillmap", *simulate, cwd=tmp_path)
    run("venv/bin/stillmap", "map", "sim", "-o", "map", "--quiet", cwd=tmp_path)
    assert (tmp_path / "map" / "map.pgm").stat().st_size > 0
