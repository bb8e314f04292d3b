"""A small simulated recording and its result, as a user of the package makes them."""

import pytest

import stillmap
from stillmap.cli.main import main

FAST = {"threads": 1, "em.max_iterations": 2}


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A recording of a hall with people."""
    out = tmp_path_factory.mktemp("interface") / "hall"
    assert main(["simulate", "hall", "-o", str(out), "--scans", "60", "--quiet"]) == 0
    return out


@pytest.fixture(scope="session")
def built(folder):
    return stillmap.build(folder, FAST, resolution=0.1)


@pytest.fixture(scope="session")
def saved(built, tmp_path_factory):
    out = tmp_path_factory.mktemp("interface") / "out"
    built.save(out)
    return out
