"""Beginnings of one recording, each measured by itself."""

from pathlib import Path

import numpy as np
import pytest
import space_growth

from stillmap.io import stillmap_folder


def test_beginnings_of_one_recording(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    changes = {"lidar": {"channels": 16, "columns": 60}, "robot": {"scans": 6}}
    space_growth.write(whole, "street", changes, 0)
    sizes = {n: space_growth.write_beginning(whole, n, tmp_path / f"first-{n}") for n in (4, 6)}
    first = stillmap_folder.read(tmp_path / "first-4")
    assert (first.n_scans, first.n_beams) == (4, 4 * 16 * 60)
    assert first.beam_time is not None
    poses = np.load(tmp_path / "first-4" / "poses.npy")
    driven = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    assert len(driven) == 3
    assert sizes[4]["metres"] == pytest.approx(driven.sum())
    assert 0.0 < sizes[4]["metres"] < sizes[6]["metres"]
    assert 0.0 < sizes[4]["area"] < sizes[6]["area"]
    assert sizes[4]["beams"] == 16 * 60

    chosen = space_growth.options_of([], 1)
    row = space_growth.cost_of(tmp_path / "first-4", chosen, tmp_path / "out")
    assert (tmp_path / "out" / "run.json").is_file()
    assert 0.0 < sum(row["stages"].values()) <= row["seconds"]
    assert max(row["peaks"].values()) <= row["peak"]
    lines = space_growth.table([{"sweeps": 4, **sizes[4], **row}]).splitlines()
    assert len(lines) == 3
    assert lines[2].split("|")[1].strip() == "4"

    row = space_growth.cost_of(tmp_path / "first-4", chosen, tmp_path / "modelled", True)
    assert (tmp_path / "modelled" / "mesh.glb").is_file()
    assert {"surface", "movers"} <= set(row["stages"])
    assert "surface" in space_growth.table([{"sweeps": 4, **sizes[4], **row}])
