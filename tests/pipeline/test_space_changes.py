"""A thing that leaves while a lidar looks, and one that comes: listed from start to end."""

import json

import numpy as np
import pytest
from choices import options

import stillmap
from stillmap.core.config import override
from stillmap.pipeline.options import Options
from stillmap.pipeline.result import map_recording
from stillmap.results.writer import save
from stillmap.sim import Scene, simulate
from stillmap.sim.options import CrowdOptions, LidarOptions, RobotOptions
from stillmap.sim.scene import Stay, Thing
from stillmap.sim.walls import box

pytestmark = pytest.mark.slow

LISTED = override(Options(), {"em": {"change_detection_3d": True}})
LEFT, CAME = (3.0, 2.0), (-3.0, 2.0)  # m, where they stand


@pytest.fixture(scope="module")
def hall():
    """60 s, two sweeps per second; at 30 s one thing is taken away and another one brought."""
    crate = tuple(box(0, 0, 1.2, 0.8))
    scene = Scene(
        "hall",
        walls=tuple(box(0, 0, 12, 9)),
        route=((-3.0, -2.0), (3.0, -2.0), (3.0, -1.0), (-3.0, -1.0)),
        things=(
            Thing(crate, (Stay(*LEFT, until=30.0),)),
            Thing(crate, (Stay(*CAME, 0.3, since=30.0),)),
        ),
        lidar=LidarOptions(channels=32, columns=360, rate=2.0, sweep=False),
        robot=RobotOptions(scans=120, speed=0.4),
        crowd=CrowdOptions(people=0),
    )
    return simulate(scene, 1)


@pytest.fixture(scope="module")
def built(hall):
    return map_recording(hall.recording, LISTED, poses=hall.truth.T_world_base)


def test_both_are_listed_and_nothing_else(built):
    result = built
    assert {one.kind for one in result.changes} == {"left", "came"}
    start = result.recording.stamp_ns[0]
    for kind, (x, y) in (("left", LEFT), ("came", CAME)):
        [one] = [one for one in result.changes if one.kind == kind]
        assert np.hypot(one.x - x, one.y - y) < 0.4
        assert 0.2 < one.z < 0.8
        assert 1e-9 * (one.before_ns - start) <= 30.0 <= 1e-9 * (one.stamp_ns - start) + 0.5
        assert np.array(one.size) == pytest.approx([1.3, 1.0, 1.0], abs=0.6)


def test_the_files_say_so(built, tmp_path):
    result = built
    save(result, tmp_path / "out")
    changes = json.loads((tmp_path / "out/run.json").read_text())["changes"]
    for one, known in zip(changes, result.changes, strict=True):
        assert (one["kind"], one["cells"]) == (known.kind, len(known.cells))
        assert (one["x"], one["y"], one["z"]) == pytest.approx(
            (known.x, known.y, known.z), abs=1e-3
        )
        assert len(one["size"]) == 3
    changed = np.load(tmp_path / "out/map.npz")["changed"]
    assert (changed == 1).sum() > 10
    assert (changed == 2).sum() > 10
    html = (tmp_path / "out/report.html").read_text()
    section = html.split(">Changed places</h2>")[1].split("</section>")[0]
    assert "2 changed places: 1 came, 1 left." in " ".join(section.split())
    assert "last observed state" not in section
    z, size = result.changes[0].z, result.changes[0].size
    assert f", {z:.2f}</td>" in section
    assert f"{size[0]:.2f} x {size[1]:.2f} x {size[2]:.2f}" in section


def test_nothing_is_listed_that_was_not_asked_for(hall):
    chosen = options("stillmap", change_detection=False)
    result = stillmap.build(hall.recording, chosen, poses=hall.truth.T_world_base)
    assert result.mapping.changes == []
    assert "changing" not in result.learned
