from pathlib import Path

import common
import pytest
from nobody import Job, found, table

from stillmap.io import writers
from stillmap.sim import scene_by_name, simulate


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short way through a hall with nobody in it."""
    path = tmp_path_factory.mktemp("nobody") / "empty.bag"
    scene = scene_by_name("hall", {"crowd": {"people": 0}, "robot": {"scans": 60}})
    writers.write(simulate(scene, 0).recording, path)
    return path


def test_an_empty_hall_is_still(bag: Path) -> None:
    job = Job(bag, None, "stillmap", ("em.max_iterations=1",))
    of = found(job)
    assert of.scans == 60
    assert 0 <= of.of_beams <= of.of_hits < 0.03
    (line,) = table([(job, of)]).splitlines()[2:]
    assert "as chosen" in line
    assert "| met " in line


def test_what_is_not_met_is_said(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = Job(bag, "/scan", "hit-ratio-0.25", ())
    monkeypatch.setitem(common.MIN_HIT_RATIO, "hit-ratio-0.25", 0.999)
    of = found(job)
    assert of.of_beams > 0.03
    assert "MISSED" in table([(job, of)])
