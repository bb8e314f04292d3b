from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rings
from numpy.typing import NDArray
from rings import BEAMS, NO_RETURN, label_columns, pose_columns, ring_of, row

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.sim.laser import Movers, cast_beams
from stillmap.sim.walls import box

Float = NDArray[np.float64]

SWEEPS = 30
ANGLES = np.arange(1200) * (2 * np.pi / 1200) + 0.001
LOOKS = np.radians([2.0, 0.3, -0.2, -2.0])
YARD = np.array([*box(0, 0, 40, 24), *box(6, 5, 3, 2), *box(-9, -6, 2, 4), *box(3, -8, 4, 1)])
NOBODY = Movers(np.zeros((1, 0, 2)), np.zeros((1, 0)), np.zeros((0, 2)), np.zeros(0, np.int32))


def way() -> Float:
    k = np.arange(SWEEPS)
    return se2.matrix(-12.0 + 0.4 * k, 1.0, 0.004 * k)


def ranges(pose: Float, walls: Float) -> Float:
    return np.asarray(cast_beams(se2.parameters(pose)[None], ANGLES, walls, NOBODY).range[0])


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A yard with a van that drives past; the ring that looks down a little misses most beams."""
    parts, labels = [], []
    for k, pose in enumerate(way()):
        van = np.array(box(-10.0 + 0.8 * k, 5.0, 4.0, 1.6))
        walls, all_of_it = ranges(pose, YARD), ranges(pose, np.concatenate([YARD, van]))
        for number, looks in enumerate(LOOKS):
            kept = np.arange(len(ANGLES)) % 10 < (9 if number == 1 else 5)
            r = all_of_it[kept]
            flat = r[:, None] * np.stack([np.cos(ANGLES[kept]), np.sin(ANGLES[kept])], axis=-1)
            parts.append(np.c_[flat, r * np.tan(looks)])
            labels.append((all_of_it < walls)[kept].astype(np.int8))
    sizes = [len(part) for part in parts]
    offset = np.concatenate([[0], np.cumsum(sizes)])[:: len(LOOKS)]
    poses = np.tile(np.eye(4), (SWEEPS, 1, 1))
    poses[:, :2, :2], poses[:, :2, 3] = way()[:, :2, :2], way()[:, :2, 2]
    poses[:, 2, 3] = 1.7
    path = tmp_path_factory.mktemp("packs") / "yard.npz"
    xyz = np.round(np.concatenate(parts) / 0.0025).astype(np.int16)
    np.savez(path, xyz_2p5mm=xyz, offset=offset, pose=poses, label=np.concatenate(labels))
    return path


def test_the_fullest_of_the_level_rings_is_taken(pack: Path) -> None:
    ring = ring_of(pack, 0.0)
    assert ring.elevation == pytest.approx(LOOKS[1], abs=1e-3)
    assert ring_of(pack, LOOKS[3]).elevation == pytest.approx(LOOKS[3], abs=1e-3)
    with pytest.raises(InputError, match="no ring"):
        ring_of(pack, np.radians(5.0))


def test_beams_are_its_end_points_seen_from_above(pack: Path) -> None:
    ring = ring_of(pack, 0.0)
    recording = ring.recording
    assert recording.n_scans == SWEEPS
    assert recording.n_beams == SWEEPS * BEAMS
    assert np.diff(recording.stamp_ns).tolist() == [100_000_000] * (SWEEPS - 1)
    points = recording.points.reshape(SWEEPS, BEAMS, 2).astype(float)
    bearing = np.arctan2(points[..., 1], points[..., 0])
    middles = (np.arange(BEAMS) + 0.5) * (2 * np.pi / BEAMS) - np.pi
    assert np.abs(bearing - middles).max() <= np.pi / BEAMS + 1e-3
    metres = np.hypot(points[..., 0], points[..., 1])
    hit = recording.hit.reshape(SWEEPS, BEAMS)
    assert 0.85 < hit.mean() < 0.95
    np.testing.assert_allclose(metres[~hit], NO_RETURN, atol=1e-4)
    # 1200 angles for 900 beams: the nearest one is half a step of theirs away at most
    k, beam = 7, 123
    nearest = np.argmin(np.abs(se2.wrap(ANGLES - bearing[k, beam])))
    van = np.array(box(-10.0 + 0.8 * k, 5.0, 4.0, 1.6))
    truth = ranges(way()[k], np.concatenate([YARD, van]))[nearest]
    assert metres[k, beam] == pytest.approx(truth, abs=0.005)
    assert ring.reference is not None
    np.testing.assert_allclose(ring.reference, way(), atol=1e-12)


def test_marks_stay_with_their_beams(pack: Path) -> None:
    ring = ring_of(pack, 0.0)
    recording = ring.recording
    assert (ring.label[~recording.hit] == -1).all()
    T = np.repeat(recording.T_map_sensor(way()), BEAMS, axis=0)
    y = np.einsum("nij,nj->ni", T[:, :2, :2], recording.points)[:, 1] + T[:, 1, 2]
    on_van = ring.label == 1
    assert on_van.sum() > 300
    assert ((y[on_van] > 4.1) & (y[on_van] < 5.9)).all()


def test_beam_times_go_round_with_the_scanner(pack: Path) -> None:
    assert ring_of(pack, 0.0).recording.beam_time is None
    for turn in (0.1, -0.1):
        times = ring_of(pack, 0.0, turn).recording.beam_time
        assert times is not None
        first = times[:BEAMS]
        # behind, to the right, ahead, to the left
        shown = first[[0, BEAMS // 4, BEAMS // 2, 3 * BEAMS // 4]]
        np.testing.assert_allclose(shown, turn * np.array([-0.5, -0.25, 0, 0.25]), atol=1e-4)


def test_what_the_pack_says_of_time_is_kept(pack: Path, tmp_path: Path) -> None:
    data: dict[str, Any] = dict(np.load(pack))
    del data["label"], data["pose"]
    np.savez(tmp_path / "timed.npz", t=5.0 + 0.2 * np.arange(SWEEPS), **data)
    ring = ring_of(tmp_path / "timed.npz", 0.0)
    assert ring.recording.stamp_ns[:2].tolist() == [5_000_000_000, 5_200_000_000]
    assert ring.reference is None
    assert (ring.label == -1).all()
    assert pose_columns(ring, np.zeros((SWEEPS, 4))) == ["-"] * 3
    assert label_columns(ring, np.ones(SWEEPS * BEAMS, np.float32)) == ["0", "-", "0", "-"]


def test_scores_are_those_of_known_poses_and_labels(pack: Path) -> None:
    ring = ring_of(pack, 0.0)
    x, y, theta = se2.parameters(way()).T
    seconds = 0.1 * np.arange(SWEEPS)
    path, ate, drift = pose_columns(ring, np.c_[seconds, x, y, theta])
    assert (path, ate, drift) == ("11.6", "0.000", "0.00")
    longer = np.c_[seconds, 1.1 * x, 1.1 * y, theta]
    assert float(pose_columns(ring, longer)[2]) == pytest.approx(10.0, abs=0.05)
    with pytest.raises(InputError, match="stamps"):
        pose_columns(ring, longer + 1.0)
    p_static = np.where(ring.label == 1, 0.2, 0.9).astype(np.float32)
    moving, found, static, wrong = label_columns(ring, p_static)
    assert (found, wrong) == ("1.0000", "0.0000")
    assert int(moving) > 300
    assert int(static) > 10_000
    assert label_columns(ring, 1 - p_static)[1::2] == ["0.0000", "1.0000"]


def test_a_ring_is_mapped(pack: Path, tmp_path: Path) -> None:
    ring = ring_of(pack, 0.0)
    flags = ["--threads", "1", "--resolution", "0.1", "--set", "em.max_iterations=2"]
    columns = ["yard", *row(ring, tmp_path / "yard", flags)]
    assert len(columns) == len(rings._HEADER)
    of = dict(zip(rings._HEADER[:9], columns, strict=False))
    # 600 beams have one of the 1200 angles, 300 have two; one angle in ten saw nothing
    assert (of["scans"], of["path m"], of["hits"]) == ("30", "11.6", "0.933")
    assert float(of["ATE m"]) < 0.05
    found, wrong = columns[9], columns[11]
    assert float(found) > 0.8
    assert float(wrong) < 0.1
    assert columns[12].startswith("2 (")
    assert (tmp_path / "yard" / "map" / "map.pgm").exists()
