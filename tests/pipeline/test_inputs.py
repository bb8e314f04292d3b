"""What `build` makes of poor recordings, of wrong arguments, and of odometry that is off."""

import dataclasses

import numpy as np
import pytest
from choices import options, with_any_estimator
from recordings import of_one_sensor

import stillmap
from stillmap.core import se2
from stillmap.core.config import override
from stillmap.core.recording import Recording
from stillmap.em import beam_counting

NOT_FINITE = (np.nan, np.inf, -np.inf)


@pytest.mark.parametrize("how", ["one scan", "no hits", "all unusable", "no beams"])
@pytest.mark.parametrize("odometry", [True, False])
@with_any_estimator
def test_recordings_of_next_to_nothing(short, tmp_path, how, odometry, estimator):
    r = short.recording if odometry else short.recording.without_odometry()
    nowhere = np.zeros(r.n_beams, bool)
    if how == "one scan":
        r = r.slice_scans(0, 1)
    elif how == "no hits":
        r = dataclasses.replace(r, hit=nowhere)
    elif how == "all unusable":
        r = dataclasses.replace(r, hit=nowhere, points=np.full_like(r.points, np.nan))
    else:
        offset = np.zeros_like(r.offset)
        r = dataclasses.replace(r, hit=nowhere[:0], points=r.points[:0], offset=offset)
    result = stillmap.build(r, options(estimator, max_iterations=2))
    assert result.poses.shape == (r.n_scans, 3, 3)
    assert np.isfinite(result.poses).all()
    assert result.p_static.shape == (r.n_beams,)
    if how == "no hits":
        defaults = stillmap.Options().em
        prior = 1 - beam_counting.MIN_HIT_RATIO if estimator == "hit-ratio" else defaults.prior
        np.testing.assert_array_equal(result.p_static, np.float32(prior))
        assert not (result.map.p_occupied > 0.2).any()  # not seen to be anything
        assert not (result.raw_map.p_occupied > 0).any()
    if how == "one scan":
        assert (result.p_static[r.hit] > 0.0).all()
        assert (result.map.p_occupied > 0.3).any()
    if how in ("all unusable", "no beams"):
        assert np.isnan(result.map.p_occupied).all()
    result.save(tmp_path / "out")
    assert np.load(tmp_path / "out/map.npz")["p_occupied"].shape == result.map.p_occupied.shape


def test_what_cannot_be_mapped_is_refused():
    nothing = np.zeros(0, np.int64), np.zeros(1, np.int64), np.zeros((0, 2), np.float32)
    empty = of_one_sensor(*nothing, np.zeros(0, bool))
    with pytest.raises(ValueError, match="at least one scan"):
        stillmap.build(empty)


@pytest.mark.parametrize("length", [1, 5, 7])
def test_poses_of_another_length_are_refused(short, length):
    poses = np.tile(np.eye(3), (length, 1, 1))
    with pytest.raises(ValueError):  # noqa: PT011  whichever layer notices first
        stillmap.build(short.recording, options(max_iterations=1), poses=poses)


def test_progress_is_told(short):
    told = []
    stillmap.build(short.recording, options(max_iterations=2), progress=lambda *at: told.append(at))
    T = short.recording.n_scans
    iterations = sorted({iteration for _, iteration, _, _ in told if iteration})
    assert iterations == list(range(1, len(iterations) + 1))
    for iteration in iterations:
        mapping = [at for at in told if at[0] == "matching scans" and at[1] == iteration]
        assert mapping[-1][2:] == (T, T)
    first = [what for what, iteration, _, _ in told if iteration == 1]
    steps = ["matching scans", "closing loops", "refining poses", "counting beams"]
    assert list(dict.fromkeys(first)) == [*steps, "labelling beams"]
    assert all(done <= total for _, _, done, total in told)
    after = [at for at in told if at[1] == 0]
    steps = ["calibrating", "labelling beams", "making the map", "counting observations"]
    steps += ["tracking objects", "rating the map"]
    assert after == [(step, 0, 0, 0) for step in steps]
    assert after[1:] == told[-5:]


@pytest.mark.parametrize(
    ("leap", "said"),
    [
        ((0.0, 0.0, np.radians(170)), "found by a wider search, outside"),
        ((30.0, 0.0, 0.0), "odometry and scans disagree ("),
    ],
)
def test_a_leap_of_the_odometry_is_reported(room, leap, said):
    T = room.recording.T_odom_base.copy()
    increment = se2.inverse(T[29]) @ T[30]
    # the motion prior widens with the leap; sure wheels that are wrong are the hard case
    sure = {"translation_per_metre": 0.0, "rotation_per_radian": 0.0, "rotation_per_metre": 0.0}
    sure["translation_per_radian"] = 0.0
    T[30:] = T[29] @ se2.matrix(*leap) @ increment @ se2.inverse(T[30]) @ T[30:]
    r = dataclasses.replace(room.recording, T_odom_base=T)
    chosen = override(options(max_iterations=1), {"slam": {"odometry": sure}})
    result = stillmap.build(r, chosen)
    assert any(said in warning for warning in result.warnings), result.warnings
    plain = stillmap.build(room.recording, chosen).warnings
    assert not any(said[:20] in warning for warning in plain)


def _transform(dimension, x=0.0, rotation=1.0):
    T = np.eye(dimension + 1)
    T[0, dimension] = x
    T[:dimension, :dimension] *= rotation
    return T


def _small_recording(dimension, mount=None):
    rng = np.random.default_rng(1)
    stamps, still = np.arange(4) * 10**8, np.tile(np.eye(dimension + 1), (4, 1, 1))
    if dimension == 2:
        angles = np.linspace(-3.0, 3.0, 60)
        ranges = 3.0 + rng.normal(0.0, 0.01, (4, 60))
        return Recording.from_scans(stamps, ranges, angles, still, sensor_pose=mount)
    clouds = rng.normal(size=(4, 60, 3))
    return Recording.from_clouds(stamps, list(clouds), still, sensor_pose=mount)


@pytest.mark.parametrize("metres", [1.01e5, 1e7, 9e8])
@pytest.mark.parametrize("dimension", [2, 3])
def test_far_mounts_are_named(dimension, metres):
    """As when files are read; a kernel would only say that some point is too far away."""
    recording = _small_recording(dimension, _transform(dimension, metres))
    with pytest.raises(stillmap.InputError, match=r"sensor 0 is mounted .* m from"):
        stillmap.build(recording, {"threads": 1})


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        *[("T_base_sensor", {"x": x}, "no rigid transform") for x in NOT_FINITE],
        *[("T_base_sensor", {"x": x}, "no rigid transform") for x in (1e30, 1e300)],
        *[("T_base_sensor", {"rotation": r}, "no rigid transform") for r in (0.0, -1.0, 2.0)],
        *[("T_odom_base", {"x": x}, "odometry: expected") for x in (1e10, 1e300, *NOT_FINITE)],
        *[("T_odom_base", {"rotation": r}, "odometry: expected") for r in (0.0, 3.0, np.nan)],
        ("stamp_ns", np.arange(4)[::-1], "stamps must not fall"),
        ("stamp_ns", np.array([0, 4 * 10**18, 4 * 10**18, -4 * 10**18]), "stamps must not fall"),
    ],
)
@pytest.mark.parametrize("dimension", [2, 3])
def test_transforms_that_are_none_are_named(dimension, name, value, what):
    """Of recordings that no reader and no constructor has checked."""
    recording = _small_recording(dimension)
    if isinstance(value, dict):
        array = getattr(recording, name).copy()
        array[-1] = _transform(3 if array.shape[-1] == 4 else 2, **value)
        # a turn by half a circle in the plane, a mirror in space
        if value.get("rotation") == -1.0 and dimension == 2:
            array[-1, 0, 0] = 1.0
        value = array
    recording = dataclasses.replace(recording, **{name: value})
    with pytest.raises(stillmap.InputError, match=what):
        stillmap.build(recording, {"threads": 1})
