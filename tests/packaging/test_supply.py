"""Licenses of what is needed at run time, and constraints.txt, the versions that were tested."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
TOOL = ROOT / "tools" / "supply.py"


@pytest.fixture(scope="module")
def supply():
    spec = importlib.util.spec_from_file_location("supply", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def constraints():
    """Versions by normalized name."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = [line.split("==") for line in lines if not line.startswith("#")]
    assert all(len(pair) == 2 for pair in pairs)
    return dict(pairs)


def test_licenses_are_permissive():
    done = subprocess.run([sys.executable, TOOL, "licenses"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert re.search(r"^numpy +BSD-3-Clause", done.stdout, re.MULTILINE)
    assert done.stdout.endswith(" packages, 0 at fault\n")


@pytest.mark.parametrize(
    ("stated", "fault"),
    [
        ("MIT", ""),
        ("Apache-2.0 OR GPL-3.0-only", ""),
        ("(MIT OR Apache-2.0) AND BSD-3-Clause", ""),
        ("BSD License", ""),
        ("", "unknown, or not installed"),
        ("GPL-3.0-only", "not known to be permissive"),
        ("MIT AND LGPL-2.1-or-later", "not known to be permissive"),
        ("Proprietary", "not known to be permissive"),
        ("GNU Affero General Public License v3", "not known to be permissive"),
        ("MPL-2.0", "not known to be permissive"),
    ],
)
def test_other_licenses_are_faults(supply, monkeypatch, stated, fault):
    monkeypatch.setattr(supply, "stated_license", lambda _: stated)
    assert list(supply.check_licenses(["some"])) == [("some", stated, fault)]


def test_packages_that_are_not_installed_are_faults(supply):
    assert next(supply.check_licenses(["no-such-package"]))[2] == "unknown, or not installed"


def test_constraints_name_all_that_is_needed_within_its_bounds(supply, constraints):
    assert set(supply.find_dependencies((*supply.RUNTIME, "test"))) <= constraints.keys()
    groups = supply.PROJECT["optional-dependencies"]
    more = (text for name in (*supply.RUNTIME, "test") for text in groups[name])
    for one in map(Requirement, [*supply.PROJECT["dependencies"], *more]):
        if one.name != "stillmap" and (one.marker is None or one.marker.evaluate()):
            assert one.specifier.contains(constraints[supply.normalize(one.name)]), str(one)
