"""Seeds of fuzzing are valid, and mutated containers stay readable."""

import random

import pytest

for needed in ("pye57", "laspy", "lazrs", "lzf"):
    pytest.importorskip(needed)
import targets  # noqa: E402
from run import NAMES  # noqa: E402

READ = sorted(set(targets.TARGETS) - {"toml", "rows", "result"})


@pytest.fixture
def checked(monkeypatch):
    """The recordings that were read and checked so far."""
    found = []
    check = targets._check_recording
    monkeypatch.setattr(targets, "_check_recording", lambda one: found.append(check(one)))
    return found


def test_every_target_is_run():
    assert sorted(NAMES) == sorted(targets.TARGETS)


@pytest.mark.parametrize("name", NAMES)
def test_seeds(tmp_path, checked, name):
    (tmp_path / "made").mkdir()
    target = targets.TARGETS[name]
    seeds = list(target.seeds(tmp_path / "made"))
    for number, seed in enumerate(seeds):
        (tmp_path / f"{number}").mkdir()
        target.run(seed, tmp_path / f"{number}")
    assert seeds
    assert len(checked) == (len(seeds) if name in READ else 0) or name == "result"


@pytest.mark.parametrize("name", ["bag", "mcap", "db3", "pcd", "e57"])
def test_unmutated_containers(tmp_path, monkeypatch, checked, name):
    monkeypatch.setattr(targets.containers, "_ODD", (1,))
    monkeypatch.setattr(targets.containers, "_HOSTILE", ("PRAGMA user_version = 1",))
    target = targets.TARGETS[name]
    (tmp_path / "made").mkdir()
    for number, seed in enumerate(target.seeds(tmp_path / "made")):
        for chance in range(3):
            place = tmp_path / f"{number} {chance}"
            place.mkdir()
            target.run(target.mutate(seed, bytes, random.Random(chance)), place)
    assert len(checked) >= 3
