"""Recordings of a small room as no sensor would take them: numbers that are none or far too large,
stamps in any order, few beams or very many, and the files that hold them."""

import json
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from hypothesis import strategies as st

import stillmap
from stillmap.core import se2

FAR = 1e7  # m, of poses and odometry
MAX_SCANS = 10
MAX_BEAMS = 100_000  # of a scan
_MANY = {2: 300_000, 3: 150_000}  # beams of a recording, by dimension: more take seconds

_ODD = (0.0, -0.0, -1.0, 1e-30, 1e-3, 5.0, 99.0, 300.0, 990.0, 7e3, 9e4, 1.1e5, 1e9, 3e38, -1e9)
# of ranges that differ from beam to beam: m, to the power of ten; files with 1e5 are refused
_SPREAD_FROM, _SPREAD_TO = -1.0, (2.0, 3.0, 5.0, 9.0)
_NO_NUMBERS = (np.nan, np.inf, -np.inf)
_STAMPS = (0, 1, -1, 10**9, 2**53, 10**18, 4 * 10**18, -4 * 10**18)
_EXTREME_STAMPS = (2**63 - 1, -(2**63), 2**62)
_NS = 10**8  # between scans
_WORDS = (  # of `stillmap map`
    *([], [], [], ["--no-odometry"], ["--resolution", "0.3"], ["--map-mode", "raw"]),
    *(["--region", "-1", "-1", "2", "3"], ["--set", "em.change_detection=true"]),
)
_WORDS_2D = (*_WORDS, ["--paper"], ["--estimator", "hit-ratio"], ["--estimator", "tracker"])
_WORDS_3D = (
    *(*_WORDS, ["--paper"], ["--mesh"], ["--spin", "clockwise"]),
    ["--set", "read.self_filter=false"],
)


@dataclass(frozen=True, repr=False)
class OddRecording:
    """T scans of M beams by S sensors, in D dimensions; nothing about the values is sure.

    Attributes:
        stamp_ns: (T,).
        counts: (T,) beams of each scan.
        directions, ranges: (M, D) unit vectors and (M,) m, in the sensor's frame.
        sensor: (T,) indices.
        mounts: (S, D+1, D+1) T_base_sensor.
        odometry, poses: (T, D+1, D+1), or None.
        beam_time: (M,) s, or None.
        form: "arrays", "folder" or "log".
        words: of the command line.
        then: numbers of the commands that follow.
        notes: how it was made.
    """

    stamp_ns: Any
    counts: Any
    directions: Any
    ranges: Any
    sensor: Any
    mounts: Any
    odometry: Any
    poses: Any
    beam_time: Any
    form: str
    words: tuple[str, ...] = ()
    then: tuple[int, ...] = ()
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def dimension(self):
        return int(self.directions.shape[1])

    def __repr__(self):
        given = [n for n in ("odometry", "poses", "beam_time") if getattr(self, n) is not None]
        counts, stamps = self.counts.tolist(), self.stamp_ns.tolist()
        what = f"{self.dimension}D as {self.form}, scans of {counts} beams, stamps {stamps}"
        return f"<{what}, with {given}, {self.words}, then {self.then}, {self.notes}>"


@st.composite
def odd_recordings(draw, far=FAR):
    """A robot that drives through a room, with up to four faults."""
    D = draw(st.sampled_from([2, 2, 3]))
    form = draw(st.sampled_from(["arrays", "folder", "log"] if D == 2 else ["arrays", "folder"]))
    seed = draw(st.integers(0, 2**32 - 1))
    T = draw(st.integers(1, MAX_SCANS))
    sizes = st.sampled_from([0, 1, 2, 3, 12, 60, 180, 181, 360, 360, 1000, MAX_BEAMS])
    most = _MANY[D] // T
    if form == "folder":
        counts = np.array([min(draw(sizes), most) for _ in range(T)])
    else:
        counts = np.full(T, min(draw(sizes), most if form == "arrays" else 1000))
    one = _drive(np.random.default_rng(seed), D, counts, form)
    start = draw(st.sampled_from([0.0, 0.0, 100.0, far]))
    one = replace(
        one,
        stamp_ns=_stamps(draw, T),
        odometry=_moved(one.odometry, start) if draw(st.booleans()) else None,
        poses=_moved(one.poses, start) if draw(st.booleans()) else None,
        beam_time=one.beam_time if draw(st.booleans()) else None,
        words=tuple(draw(st.sampled_from(_WORDS_2D if D == 2 else _WORDS_3D))),
        then=tuple(draw(st.lists(st.integers(0, 99), max_size=2))),
        notes={"seed": seed, "start": start, "faults": []},
    )
    for _ in range(draw(st.integers(0, 4))):
        _spoil(draw, one, far)
    return one


def _drive(rng, D, counts, form):
    """A drive through a box as it should be."""
    T, M = len(counts), int(counts.sum())
    half = rng.uniform(2.0, 15.0, D)
    scan = np.repeat(np.arange(T), counts)
    turn = rng.uniform(-0.1, 0.1) * np.arange(T)
    poses = np.tile(np.eye(D + 1), (T, 1, 1))
    poses[:, :2, :2] = se2.matrix(0.0 * turn, 0.0 * turn, turn)[:, :2, :2]
    poses[:, 0, D] = rng.uniform(0.0, 0.15) * np.arange(T)
    if D == 2:
        number = np.arange(M) - np.repeat(np.cumsum(counts) - counts, counts)
        angle = 2 * np.pi * number / np.maximum(counts[scan], 1) - np.pi
        directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        directions = rng.normal(size=(M, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ahead = np.einsum("nij,nj->ni", poses[scan, :D, :D], directions)
    with np.errstate(divide="ignore"):
        ranges = ((half - np.sign(ahead) * poses[scan, :D, D]) / np.abs(ahead)).min(axis=1)
    ranges += rng.normal(0.0, 0.01, M)
    ranges[rng.random(M) < 0.1] *= rng.uniform(0.1, 1.0)  # something stands or moves in between
    S = 2 if form == "folder" and rng.random() < 0.5 else 1
    mounts = np.tile(np.eye(D + 1), (S, 1, 1))
    mounts[1:, 0, D] = 0.3
    return OddRecording(
        stamp_ns=np.arange(T) * _NS,
        counts=counts,
        directions=directions,
        ranges=ranges,
        sensor=rng.integers(0, S, T).astype(np.int32),
        mounts=mounts,
        odometry=poses.copy(),
        poses=poses,
        beam_time=rng.uniform(0.0, 0.1, M).astype(np.float32),
        form=form,
    )


def _moved(poses, metres):
    out = poses.copy()
    out[:, :-1, -1] += metres
    return out


def _stamps(draw, T):
    kind = draw(st.sampled_from([*["even"] * 4, "equal", "apart", "sorted", "any"]))
    if kind in ("even", "equal"):
        first = draw(st.sampled_from([0, 10**18]))
        return first + np.arange(T, dtype=np.int64) * (_NS if kind == "even" else 0)
    if kind == "apart":  # from microseconds to years
        step = draw(st.sampled_from([10**3, 10**9, 10**13, 10**17]))
        return np.arange(T, dtype=np.int64) * step
    values = st.sampled_from(_STAMPS if kind == "sorted" else _STAMPS + _EXTREME_STAMPS)
    some = draw(st.lists(values, min_size=T, max_size=T))
    return np.array(sorted(some) if kind == "sorted" else some, np.int64)


def _spoil(draw, one, far):
    """Put an odd value into some rows of one array."""
    names = [*["ranges"] * 3, "directions", "odometry", "poses", "beam_time", "mounts"]
    name = draw(st.sampled_from([n for n in names if getattr(one, n) is not None]))
    array = getattr(one, name)
    if not len(array):
        return
    first = draw(st.integers(0, len(array) - 1))
    rows = slice(first, first + draw(st.sampled_from([1, 1, 2, 7, len(array) // 3, len(array)])))
    if name in ("odometry", "poses", "mounts"):
        values = [0.0, 1.0, -50.0, far, -far, *_NO_NUMBERS] if name != "mounts" else [1.0, -30.0]
        value = draw(st.sampled_from(values))
        array[rows, draw(st.integers(0, one.dimension - 1)), one.dimension] = value
    elif name == "ranges" and draw(st.integers(0, 3)) == 0:
        value = draw(st.sampled_from(_SPREAD_TO))
        rng = np.random.default_rng(one.notes["seed"])
        array[rows] = 10.0 ** rng.uniform(_SPREAD_FROM, value, len(array[rows]))
        name = "spread"
    else:
        value = draw(st.sampled_from([*_ODD, *_NO_NUMBERS, *_NO_NUMBERS]))
        with np.errstate(over="ignore"):
            array[rows] = value
    one.notes["faults"].append((name, rows.start, rows.stop, value))


def to_recording(one):
    """The recording, by its constructors.

    Raises:
        ValueError: they refuse it.
    """
    T, D = len(one.counts), one.dimension
    if D == 2:
        n = int(one.counts[0])
        angles = np.arctan2(*one.directions[:n, ::-1].T)
        step = 0.0 if one.beam_time is None or not n else float(one.beam_time[0])
        scans = one.stamp_ns, one.ranges.reshape(T, n), angles, one.odometry
        return stillmap.Recording.from_scans(*scans, time_increment=step)
    ends = np.cumsum(one.counts)[:-1]
    with np.errstate(all="ignore"):
        points = one.ranges[:, None] * one.directions
    times = None if one.beam_time is None else np.split(one.beam_time, ends)
    clouds = one.stamp_ns, np.split(points, ends), one.odometry
    return stillmap.Recording.from_clouds(*clouds, beam_times=times)


def write(one, folder):
    """The files of a recording, written without any check; returns the path to read."""
    if one.form == "log":
        path = folder / "odd.log"
        path.write_text("".join(f"{line}\n" for line in _log_lines(one)), encoding="ascii")
        return path
    path = folder / "odd"
    path.mkdir()
    with np.errstate(all="ignore"):
        points = (one.ranges[:, None] * one.directions).astype(np.float32)
    arrays = {
        "stamp_ns": one.stamp_ns,
        "offset": np.concatenate([[0], np.cumsum(one.counts)]).astype(np.int64),
        "points": points,
        "hit": np.isfinite(points).all(axis=1) & (one.ranges < 900.0),
        "T_base_sensor": one.mounts,
        "sensor": one.sensor,
        "T_odom_base": one.odometry,
        "beam_time": one.beam_time,
        "T_recorded_base": one.poses,
    }
    for name, array in arrays.items():
        if array is not None:
            np.save(path / f"{name}.npy", array)
    header = {
        "format": "stillmap-recording",
        "format_version": 1,
        "dimension": one.dimension,
        "scans": len(one.counts),
        "beams": len(points),
        "sensors": len(one.mounts),
        "odometry": one.odometry is not None,
        "beam_times": one.beam_time is not None,
        "recorded_poses": one.poses is not None,
        "source": {"format": "simulation"},
    }
    (path / "recording.json").write_text(json.dumps(header), encoding="utf-8")
    return path


def _log_lines(one):
    n = int(one.counts[0])
    T = one.odometry if one.odometry is not None else np.tile(np.eye(3), (len(one.counts), 1, 1))
    scans = one.ranges.reshape(len(T), n).tolist()
    poses = np.column_stack([T[:, :2, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])]).tolist()
    for ranges, pose, seconds in zip(scans, poses, (one.stamp_ns / 1e9).tolist(), strict=True):
        readings = " ".join(map(repr, [n, *ranges, *pose, *pose, seconds]))
        yield f"FLASER {readings} host {seconds!r}"


def write_poses(one, path):
    """The poses as a TUM trajectory, likewise."""
    D, lines = one.dimension, []
    for stamp, T in zip(one.stamp_ns.tolist(), one.poses, strict=True):
        half = np.arctan2(T[1, 0], T[0, 0]) / 2
        xyz = [*T[:D, D].tolist(), 0.0][:3]
        words = [*xyz, 0.0, 0.0, float(np.sin(half)), float(np.cos(half))]
        sign, whole = "-" * (stamp < 0), abs(stamp)
        lines.append(f"{sign}{whole // 10**9}.{whole % 10**9:09d} {' '.join(map(repr, words))}\n")
    path.write_text("".join(lines), encoding="ascii")
