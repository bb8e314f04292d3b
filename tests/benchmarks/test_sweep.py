from pathlib import Path

import numpy as np
import pytest
from sweep import FIGURES, against_wanted, in_fresh_process, speeds, sweep, write

import stillmap
from stillmap.core.profiling import peak_memory_bytes


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sweep")


def test_long_recording_is_written_read_and_swept(work: Path) -> None:
    cells = write(work, 60, 90)
    assert stillmap.read(work / "recording").n_beams == 60 * 90
    assert np.load(work / "poses.npy").shape == (60, 3, 3)
    assert cells > 60 * 90 * 10
    found = sweep(work, 2)
    assert found["sweep"] == pytest.approx(found["m_step"] + found["e_step"])
    assert min(found["m_step"], found["e_step"]) > 0
    assert found["peak"] >= found["loaded"] > 20
    assert {column.key for column, _ in FIGURES} == {*found, *speeds(found, cells)}


def test_memory_is_that_of_the_process_measured_alone() -> None:
    hoard = np.ones(40_000_000)  # 320 MB that count here and must not count there
    here, there = peak_memory_bytes(), in_fresh_process(peak_memory_bytes)
    assert here > hoard.nbytes
    assert 5e6 < there < 250e6


def test_figures_are_held_against_what_is_wanted() -> None:
    row = {"m_step": 2.0, "e_step": 4.0, "sweep": 6.0, "loaded": 100.0, "peak": 400.0}
    rounds = [row, row, {**row, "e_step": 20.0, "sweep": 22.0, "peak": 501.0}]
    rounds = [{**r, **speeds(r, 1_000_000_000)} for r in rounds]
    lines = against_wanted(rounds).splitlines()
    cells = [[cell.strip() for cell in text.split("|")[1:-1]] for text in lines]
    table = {name: rest for name, *rest in cells}
    assert table["both, s"] == ["6.00", "22.00", "<= 10", "met"]
    assert table["M-step, M cells/s"] == ["500", "500", ">= 200", "met"]
    assert table["E-step, M cells/s"] == ["250", "50", ">= 200", "met"]
    # no round may need more
    assert table["peak memory, MB"] == ["400", "501", "<= 500", "MISSED"]
