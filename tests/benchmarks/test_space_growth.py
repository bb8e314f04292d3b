"""Beginnings of one recording, each measured by itself."""

from pathlib import Path

import numpy as np
import pytest
import space_growth


def test_beginnings_of_one_recording(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    changes = {"lidar": {"channels": 16, "columns": 60}, "robot": {"scans": 6}}
    space_growth.write(whole, "street", changes, 0)
    recording, poses = space_growth.beginning(whole, 4)
    assert (recording.n_scans, recording.n_beams, len(poses)) == (4, 4 * 16 * 60, 4)
    assert recording.beam_time is not None

    short, long = (space_growth.size_of(whole, sweeps) for sweeps in (4, 6))
    walked = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum()
    assert short["metres"] == pytest.approx(walked)
    assert 0.0 < short["metres"] < long["metres"]
    assert 0.0 < short["area"] < long["area"]
    assert short["beams"] == 16 * 60

    row = space_growth.cost_of(whole, 4, space_growth.options_of([], 1), tmp_path / "out")
    assert (tmp_path / "out" / "run.json").is_file()
    assert 0.0 < sum(row["stages"].values()) <= row["seconds"]
    assert max(row["peaks"].values()) <= row["peak"]
    lines = space_growth.table([{"sweeps": 4, **short, **row}]).splitlines()
    assert len(lines) == 3
    assert lines[2].split("|")[1].strip() == "4"
