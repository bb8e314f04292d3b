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
# prints what cannot be imported with the base dependencies alone, except for servers
IMPORT_ALL = """
import importlib, pkgutil, stillmap
for module in pkgutil.walk_packages(stillmap.__path__, "stillmap."):
    if module.name == "stillmap.__main__" or module.name.startswith("stillmap.live.ros."):
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        extra = {"viser": "viewer", "websockets": "viewer", "foxglove": "live.foxglove_server"}
        if extra.get(error.name, " ") not in module.name:
            print(module.name, error.name)
"""
JUNK = re.compile(r"\.(so|pyc|egg-info)$|__pycache__|/(build|dist|demo|\.venv|\.ci|\.git\w*)(/|$)")

MAX_BASE_MB = 350  # of stillmap and its base dependencies, without compiled bytecode

TEMPLATES = [str(path.relative_to(ROOT / "src")) for path in (ROOT / "src").rglob("*.j2")]


def run(*command, cwd, path=None):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    if path is not None:
        environment["PATH"] = path
    how = {"cwd": cwd, "env": environment, "capture_output": True, "text": True}
    done = subprocess.run([str(part) for part in command], **how, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def size_mb(folder):
    """Bytes of the files below a folder, in MB, without bytecode that Python makes when it runs."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc")
    return sum(path.stat().st_size for path in files) / 1e6


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """What `make wheel` writes: a source archive, and a wheel built from it in isolation."""
    folder = tmp_path_factory.mktemp("archives")
    run(ROOT / "tools" / "build_wheel.sh", sys.executable, folder, cwd=folder)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


@pytest.fixture
def wheel(archives):
    return archives[1]


def test_source_archive_is_complete(archives):
    with tarfile.open(archives[0]) as archive:
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
    info = "-".join(wheel.name.split("-")[:2]) + ".dist-info"
    assert len(names) == len(set(names))
    assert {name.split("/")[0] for name in names} == {"stillmap", info}
    assert [name for name in names if name.endswith(".pyi")] == ["stillmap/_core.pyi"]
    assert len([name for name in names if name.endswith(".so")]) == 1
    assert {"stillmap/py.typed", *TEMPLATES} <= set(names)
    assert f"{info}/licenses/LICENSE" in names


@pytest.mark.skipif(sys.platform != "linux", reason="manylinux is of Linux")
def test_wheel_is_for_every_linux_of_its_tag(wheel):
    assert re.search(r"-manylinux_2_\d+_\w+\.whl$", wheel.name)


def test_wheel_maps_in_a_bare_environment(wheel, tmp_path):
    """Without a compiler on the path, and with nothing but wheels of the base dependencies."""
    run(sys.executable, "-m", "venv", "venv", cwd=tmp_path)
    bare = str(tmp_path / "venv" / "bin")
    pip = ("venv/bin/python", "-m", "pip", "install", "--no-compile", "--only-binary=:all:")
    before = size_mb(tmp_path / "venv")
    run(*pip, wheel, cwd=tmp_path, path=bare)
    assert size_mb(tmp_path / "venv") - before <= MAX_BASE_MB
    assert run("venv/bin/python", "-c", IMPORT_ALL, cwd=tmp_path, path=bare).split() == []
    simulate = ("simulate", "hall", "-o", "sim", "--scans", "60")
    run("venv/bin/stillmap", *simulate, cwd=tmp_path, path=bare)
    run("venv/bin/stillmap", "map", "sim", "-o", "map", "--quiet", cwd=tmp_path, path=bare)
    assert (tmp_path / "map" / "map.pgm").stat().st_size > 0
