"""Recordings made from arrays: what the numbers mean, and how wrong ones are refused."""

import numpy as np
import pytest

import stillmap

T, N = 40, 181
ANGLES = np.linspace(-np.pi / 2, np.pi / 2, N)
STAMPS = 1.7e9 + 0.1 * np.arange(T)


def walls(x):
    """Ranges of N beams in a room of 10 m x 6 m, x metres from the middle."""
    along, across = np.cos(ANGLES), np.sin(ANGLES)
    with np.errstate(divide="ignore"):
        return np.minimum((5.0 - x) / along.clip(1e-9), 3.0 / np.abs(across).clip(1e-9))


RANGES = np.stack([walls(0.02 * t) for t in range(T)])
ODOMETRY = np.stack([0.02 * np.arange(T), np.zeros(T), np.zeros(T)], axis=1)


def scans(ranges=RANGES, **more):
    return stillmap.Recording.from_scans(STAMPS, ranges, ANGLES, ODOMETRY, **more)


def test_points_lie_along_the_angles():
    recording = scans()
    points = recording.points.reshape(T, N, 2)
    np.testing.assert_allclose(np.linalg.norm(points, axis=2), RANGES, rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(points[3, :, 1], points[3, :, 0]), ANGLES, atol=1e-6)
    assert recording.hit.all()
    assert recording.offset.tolist() == list(range(0, T * N + 1, N))
    np.testing.assert_allclose(recording.T_odom_base[7, :2, 2], ODOMETRY[7, :2])


def test_readings_mean_what_they_mean_in_a_laser_scan():
    ranges = RANGES.copy()
    ranges[:, 0], ranges[:, 1], ranges[:, 2], ranges[:, 3] = np.nan, np.inf, -1.0, -np.inf
    recording = scans(ranges, min_range=0.1, max_range=3.5)
    hit, points = recording.hit.reshape(T, N), recording.points.reshape(T, N, 2)
    assert not hit[:, :4].any()
    unusable = np.isnan(points).any(axis=2)
    assert unusable[:, [0, 2, 3]].all()
    assert not unusable[:, [1, *range(4, N)]].any()
    far = ranges >= 3.5
    assert far[:, 4:].any()
    assert not hit[far].any()
    np.testing.assert_allclose(np.linalg.norm(points[far], axis=1), 3.5, rtol=1e-3)


@pytest.mark.parametrize(
    "stamps",
    [
        np.rint(STAMPS * 1e9).astype(np.int64),
        (STAMPS * 1e3).round().astype("datetime64[ms]"),
        STAMPS.tolist(),
    ],
    ids=["nanoseconds", "datetime64", "list"],
)
def test_forms_of_stamps(stamps):
    other = stillmap.Recording.from_scans(stamps, RANGES, ANGLES)
    assert np.abs(other.stamp_ns - scans().stamp_ns).max() < 1000
    assert other.T_odom_base is None


def test_matrices_and_a_mount():
    T_odom_base = scans().T_odom_base
    recording = stillmap.Recording.from_scans(
        STAMPS, RANGES, ANGLES, T_odom_base, sensor_pose=(0.2, 0.0, np.pi), time_increment=1e-4
    )
    np.testing.assert_array_equal(recording.T_odom_base, T_odom_base)
    np.testing.assert_allclose(recording.T_base_sensor[0, :2, 2], (0.2, 0.0))
    np.testing.assert_allclose(recording.beam_time[:3], (0.0, 1e-4, 2e-4))


def changed(**arguments):
    given = {"stamps": STAMPS, "ranges": RANGES, "angles": ANGLES, "odometry": ODOMETRY}
    return stillmap.Recording.from_scans(**{**given, **arguments})


NAN_POSE = np.where(np.arange(T)[:, None] == 3, np.nan, ODOMETRY)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"stamps": STAMPS[:, None]}, r"stamps: expected \(T,\) seconds .* got \(40, 1\) float64"),
        ({"stamps": []}, "stamps: expected .* T >= 1"),
        ({"stamps": ["a"] * T}, "stamps: expected"),
        ({"stamps": STAMPS[::-1]}, "stamps: expected no decrease, got .* at 1"),
        ({"stamps": np.where(np.arange(T) == 5, np.nan, STAMPS)}, "stamps: .* got nan at 5"),
        ({"stamps": STAMPS + 4.7e9}, "stamps: expected times from 1824 to 2116"),
        ({"stamps": np.full(T, 2**63 - 1)}, "stamps: expected times from 1824 to 2116"),
        ({"stamps": np.full(T, "3000-01-01", "datetime64[s]")}, "stamps: expected times from"),
        ({"stamps": np.full(T, "NaT", "datetime64[s]")}, "stamps: expected times .* got NaT at 0"),
        ({"stamps": range(T)}, "stamps: integers are nanoseconds, these span 39 ns"),
        ({"ranges": RANGES[:-1]}, "ranges: expected 40 as in stamps, got 39"),
        ({"ranges": RANGES[0]}, r"ranges: expected \(T, N\) real numbers, got \(181,\)"),
        ({"ranges": [[1.0], [1.0, 2.0]]}, "ranges: .*rows of different lengths"),
        ({"ranges": RANGES[:, :0], "angles": []}, "ranges: expected at least one beam"),
        ({"angles": ANGLES[1:]}, "angles: expected 180|angles: expected 181 as in the columns"),
        ({"angles": np.where(ANGLES == 0, np.inf, ANGLES)}, "angles: expected finite radians"),
        ({"odometry": ODOMETRY[:-1]}, "odometry: expected 40 as in stamps, got 39"),
        ({"odometry": ODOMETRY[:, :2]}, r"odometry: expected \(T, 3\) x, y, theta or"),
        ({"odometry": NAN_POSE}, "odometry: expected rigid transforms within .* at 3"),
        ({"odometry": np.ones((T, 3, 3))}, "odometry: expected rigid transforms"),
        ({"min_range": 3.0, "max_range": 2.0}, "min_range, max_range: expected"),
        ({"min_range": float("nan")}, "min_range, max_range: expected"),
        ({"sensor_pose": (1.0, 2.0)}, r"sensor_pose: expected \(3,\) x, y, theta"),
        ({"time_increment": -1e3}, "time_increment: expected scans of up to 60 s"),
        ({"time_increment": float("inf")}, "time_increment: expected scans of up to 60 s"),
    ],
)
def test_wrong_arguments_are_named(arguments, said):
    with pytest.raises(ValueError, match=said):
        changed(**arguments)


def test_clouds():
    rng = np.random.default_rng(0)
    clouds = [rng.uniform(1.0, 5.0, (50 + t, 3)) for t in range(5)]
    clouds[2][7] = np.nan
    recording = stillmap.Recording.from_clouds(np.arange(5.0), iter(clouds), min_range=0.5)
    assert (recording.dimension, recording.n_scans, recording.n_beams) == (3, 5, 260)
    scan = recording.beams_of(2)
    np.testing.assert_allclose(recording.points[scan], clouds[2].astype(np.float32))
    assert np.flatnonzero(~recording.hit[scan]).tolist() == [7]
    times = [np.linspace(0, 0.1, len(cloud)) for cloud in clouds]
    timed = stillmap.Recording.from_clouds(np.arange(5.0), clouds, beam_times=times)
    assert timed.beam_time[-1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("count", "arguments", "said"),
    [
        (4, {}, "clouds: expected 5 as in stamps, got 4"),
        (6, {}, "clouds: expected 5 as in stamps, got more"),
        (5, {"odometry": np.zeros((5, 3))}, r"odometry: expected \(T, 4, 4\)"),
        (5, {"beam_times": [np.zeros(3)]}, "beam_times: expected 5 as in stamps, got 1"),
        (5, {"beam_times": [np.zeros(3)] * 5}, r"beam_times\[0\]: expected 4 as in clouds\[0\]"),
    ],
)
def test_wrong_clouds_are_named(count, arguments, said):
    with pytest.raises(ValueError, match=said):
        stillmap.Recording.from_clouds(np.arange(5.0), [np.ones((4, 3))] * count, **arguments)
    with pytest.raises(ValueError, match=r"clouds\[1\]: expected \(N, 3\) metres, got \(4, 2\)"):
        stillmap.Recording.from_clouds([0.0, 1.0], [np.ones((4, 3)), np.ones((4, 2))])


def test_mapped_like_the_recording_that_it_is_made_of(folder, built):
    read = stillmap.read(folder)
    n = read.n_beams // read.n_scans
    points = read.points.reshape(read.n_scans, n, 2).astype(np.float64)
    ranges = np.linalg.norm(points, axis=2)
    ranges[~read.hit.reshape(-1, n)] = np.inf
    angles = np.arctan2(points[0, :, 1], points[0, :, 0])
    made = stillmap.Recording.from_scans(read.stamp_ns, ranges, angles, read.T_odom_base)
    assert np.array_equal(made.hit, read.hit)
    result = stillmap.build(made, {"threads": 1, "em.max_iterations": 2}, resolution=0.1)
    np.testing.assert_allclose(result.poses, built.poses, atol=0.02)
    assert np.nanmean(np.abs(result.p_static - built.p_static)) < 5e-3
