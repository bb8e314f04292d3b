"""What benchmarks/models.py counts with."""

import numpy as np
import pytest
from models import COLUMNS, WORLDS, flat, walkers

from stillmap.sim import scene_by_name, simulate, write_simulation


def test_scores_in_percent_and_centimetres():
    found = flat(
        {
            "surface": {"mean": 0.012, "p95": None, "complete": 0.97},
            "movers": {"tracked": 7, "chamfer": 0.04},
        }
    )
    assert (found["mean"], found["complete"], found["tracked"]) == pytest.approx((1.2, 97.0, 7))
    assert found["chamfer"] == pytest.approx(4.0)
    assert np.isnan(found["p95"])
    assert np.isnan(found["colour_median"])
    assert set(found) == {column.key for column in COLUMNS}


def test_pictures_with_people(tmp_path):
    changes = {
        "lidar": {"channels": 1, "columns": 8},
        "robot": {"scans": 30},
        "crowd": {"people": 60},
        "camera": {"enabled": True, "width": 64, "height": 48, "count": 4},
    }
    write_simulation(simulate(scene_by_name("hall", changes), 1), tmp_path / "hall")
    assert 0.2 < walkers(tmp_path / "hall") <= 1.0
    empty = {**changes, "crowd": {"people": 0}}
    write_simulation(simulate(scene_by_name("hall", empty), 1), tmp_path / "empty")
    assert walkers(tmp_path / "empty") == 0.0


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_are_scenes_with_cameras(name):
    scene = scene_by_name(name, WORLDS[name])
    assert scene.camera.enabled
    assert scene.in_3d
