"""Citation, changelog, and the check of build tools."""

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_citation_and_changelog_name_the_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == VERSION
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= citation.keys()
    assert {"type", "title", "authors"} <= citation["preferred-citation"].keys()
    assert f"## [{VERSION}]" in (ROOT / "CHANGELOG.md").read_text()


def lacking(path, python="python3", **environment):
    """Exit status and lines of tools/require.sh with the programs of `path` alone."""
    command = ["/bin/sh", ROOT / "tools" / "require.sh", python]
    environment = {"PATH": str(path), **environment}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == ""
    return done.returncode, done.stderr.splitlines()


@pytest.fixture
def programs(tmp_path):
    """A folder of programs: those named are there, or stand-ins with the given text."""

    def make(*names, **scripts):
        for name in names:
            (tmp_path / name).symlink_to(shutil.which(name))
        for name, text in scripts.items():
            (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
            (tmp_path / name).chmod(0o755)
        return tmp_path

    return make


needs_compiler = pytest.mark.skipif(not shutil.which("g++"), reason="no g++ here")


@needs_compiler
def test_require_passes_here():
    assert lacking(os.environ["PATH"], sys.executable, CXX="g++") == (0, [])


@pytest.mark.parametrize(
    ("named", "compiler"), [({}, "g++"), ({"CXX": "nocompiler -m64"}, "nocompiler")]
)
def test_no_python_and_no_compiler(programs, named, compiler):
    no_python = "stillmap: python3 is missing: apt install python3 python3-venv python3-dev"
    no_compiler = f"stillmap: {compiler} is missing: apt install g++"
    assert lacking(programs(), **named) == (1, [no_python, no_compiler])


@needs_compiler
@pytest.mark.parametrize(
    ("refused", "line"),
    [
        ("*version_info*", "stillmap: old is too old, 3.11 or newer is needed: make PYTHON="),
        ("*ensurepip*", "stillmap: python3 cannot make virtual environments: apt install "),
        ("*Python.h*", "stillmap: the headers of python3 are missing: apt install python3-dev"),
    ],
)
def test_python_lacks_a_part(programs, refused, line):
    stand_in = f'case "$2$1" in *--version) echo old;; {refused}) exit 1;; esac'
    # the compiler's own helpers are found beside it, not on the path
    path = programs("sh", "printf", python3=stand_in)
    status, lines = lacking(f"{path}:{os.environ['PATH']}", CXX="g++")
    assert status == 1
    assert [text.startswith(line) for text in lines] == [True]


def test_compiler_too_old(programs):
    _, lines = lacking(programs(python3="exit 0", **{"g++": "cat >/dev/null; exit 1"}))
    assert lines == ["stillmap: g++ cannot compile C++17: apt install g++"]
