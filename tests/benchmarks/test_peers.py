from pathlib import Path

import numpy as np
import pytest
from karto import KartoError
from pairs import timed_poses
from peers import Found, methods, table

from stillmap.core import se2
from stillmap.sim import scene_by_name, simulate, write_simulation


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("peers") / "hall"
    write_simulation(simulate(scene_by_name("hall-empty", {"robot": {"scans": 40}}), 0), folder)
    return folder


def cells(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()[2:]]


def test_stillmap_is_run_and_a_missing_karto_is_said(hall: Path, tmp_path: Path) -> None:
    some = methods(None, ["--set", "em.max_iterations=1"])
    stillmap, karto = cells(table([hall], some, 1, tmp_path))
    assert stillmap[:3] == ["hall", "40", "stillmap"]
    mean, median, most, rotation = (float(cell) for cell in stillmap[3:7])
    assert 0.0 < median <= most
    assert 0.0 < mean < 0.1
    assert 0.0 < rotation < 1.0
    assert stillmap[7] == "1000 of 1000"
    assert 0.0 < float(stillmap[8]) < float(stillmap[9])
    assert karto == ["hall", "40", "Karto", "no --karto-python", *["-"] * 6]


def test_methods_take_turns_and_medians_are_taken(hall: Path, tmp_path: Path) -> None:
    called: list[str] = []
    truth = np.load(hall / "truth" / "T_world_base.npy")
    stamp_ns = np.load(hall / "stamp_ns.npy")

    def works(recording: Path, out: Path) -> Found:
        called.append("works")
        assert (recording, out) == (hall, tmp_path / "hall")
        poses = truth @ se2.matrix(0.0, 0.0, np.where(np.arange(40) < 20, 0.0, 0.1))
        return Found(timed_poses(stamp_ns, poses), 0.04 * len(called), 4.0)

    def fails_at_last(*_: Path) -> Found:
        called.append("fails")
        if len(called) == 6:
            raise KartoError("crashed")
        return Found(timed_poses(stamp_ns, truth), 1.0, 1.0)

    some = {"works": works, "fails": fails_at_last}
    works_row, fails_row = cells(table([hall], some, 3, tmp_path))
    assert called == ["works", "fails"] * 3
    # 0.04, 0.12, 0.20 s over 40 scans
    assert works_row[8:] == ["3.00", "100.00"]
    assert 0.0 < float(works_row[6]) < np.degrees(0.1)
    assert fails_row[3] == "crashed"
