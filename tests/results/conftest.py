"""A made-up result: a fake hall with walkers, its maps counted by dense sampling along beams."""

import re
from dataclasses import asdict, dataclass, field

import numpy as np
import pytest

from stillmap.core.config import CheckedOptions
from stillmap.core.recording import Recording
from stillmap.core.se2 import inverse, matrix
from stillmap.core.source import RangeRule, Source
from stillmap.em import Coverage, OccupancyMap
from stillmap.pipeline.em_loop import IterationRecord
from stillmap.pipeline.options import OutputOptions
from stillmap.pipeline.quality import Quality
from stillmap.pipeline.snapshots import choose_window, extent, snapshot
from stillmap.slam import BareStretch, Diagnostics, LoopClosure
from stillmap.slam.mount_calibration import Calibration
from stillmap.slam.pose_graph import Constraint, PoseGraph
from stillmap.tracking import FlowMap, MovingObject, ObjectOptions, compute_flow_map

RESOLUTION = 0.1
ORIGIN = (-1.0, -2.0, 0.0)
SHAPE = (140, 210)
MAX_RANGE = 12.0
WALLS = [
    # x0, y0, x1, y1
    (0, -1, 19, -1),
    (19, -1, 19, 11),
    (19, 11, 0, 11),
    (0, 11, 0, -1),
    (6, 4, 7, 4),
    (7, 4, 7, 5),
    (7, 5, 6, 5),
    (6, 5, 6, 4),
    (13, -1, 13, 3),
]


@dataclass(frozen=True)
class EmOptions(CheckedOptions):
    prior: float = 0.9
    note: str = "a <b>bold</b> & 'quoted' note"
    seed: int | None = None


@dataclass(frozen=True)
class FakeOptions(CheckedOptions):
    estimator: str = "stillmap"
    em: EmOptions = field(default=EmOptions())
    objects: ObjectOptions = field(default=ObjectOptions())
    output: OutputOptions = field(default=OutputOptions())


@dataclass(frozen=True, eq=False)
class FakeResult:
    recording: Recording
    options: FakeOptions
    iterations: list
    snapshots: list
    poses: np.ndarray
    p_static: np.ndarray
    map: OccupancyMap
    raw_map: OccupancyMap
    evidence: Coverage
    best_iteration: int
    converged: bool
    warnings: list
    learned: dict
    loops: list
    stages: dict
    objects: list = field(default_factory=list)
    traffic: FlowMap = field(default_factory=lambda: compute_flow_map([]))
    changes: list = field(default_factory=list)
    doors: list = field(default_factory=list)
    graph: PoseGraph | None = None
    doubts: Diagnostics = field(default_factory=Diagnostics)
    calibration: Calibration = field(default_factory=Calibration)
    quality: Quality = field(default_factory=Quality)
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def near(self):
        return self

    @property
    def deskewed(self) -> Recording:
        return self.recording


def _wall_range(origin, direction):
    """(N,) range to the nearest wall along unit directions (N, 2)."""
    best = np.full(len(direction), np.inf)
    for x0, y0, x1, y1 in WALLS:
        edge, to = np.array([x1 - x0, y1 - y0], float), np.array([x0, y0]) - origin
        cross = direction[:, 0] * edge[1] - direction[:, 1] * edge[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (to[0] * edge[1] - to[1] * edge[0]) / cross
            part = (to[0] * direction[:, 1] - to[1] * direction[:, 0]) / cross
        best = np.where((along > 0) & (part >= 0) & (part <= 1), np.minimum(best, along), best)
    return best


def _walker_range(origin, direction, centres, radius=0.25):
    best = np.full(len(direction), np.inf)
    for centre in centres:
        to = centre - origin
        along = direction @ to
        aside = (to**2).sum() - along**2
        found = (along > 0) & (aside < radius**2)
        reach = along - np.sqrt(np.maximum(radius**2 - aside, 0))
        best = np.where(found, np.minimum(best, reach), best)
    return best


def _simulate(rng, scans=60, beams=181, walkers=8):
    turn = np.linspace(0, 2 * np.pi, scans)
    poses = matrix(8.5 - 5 * np.cos(turn), 2 + 2.2 * np.sin(turn), turn / 4)
    bearing = np.linspace(-np.pi / 2, np.pi / 2, beams)
    start, heading = rng.uniform([1, 0], [18, 10], (walkers, 2)), rng.uniform(0, 6.28, walkers)
    ranges, moving = np.zeros((scans, beams)), np.zeros((scans, beams), bool)
    for t in range(scans):
        swing = 3 * np.sin(2 * turn[t] + heading)
        centres = start + swing[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
        theta = np.arctan2(poses[t, 1, 0], poses[t, 0, 0]) + bearing
        direction = np.stack([np.cos(theta), np.sin(theta)], 1)
        wall = _wall_range(poses[t, :2, 2], direction)
        walker = _walker_range(poses[t, :2, 2], direction, centres)
        moving[t] = walker < wall
        ranges[t] = np.minimum(wall, walker) + rng.normal(0, 0.01, beams)
    points = ranges[..., None] * np.stack([np.cos(bearing), np.sin(bearing)], 1)
    hit = ranges < MAX_RANGE
    points[~hit] *= (MAX_RANGE / ranges[~hit])[:, None]
    return poses, points, hit, moving


def _count(poses, points, hit, e):
    """Counts over cells: alpha where beams end, beta along them, by sampling every half cell."""
    alpha, beta = np.zeros(SHAPE), np.zeros(SHAPE)
    share = np.linspace(0, 1, 240, endpoint=False)
    for t in range(len(poses)):
        ends = points[t] @ poses[t, :2, :2].T + poses[t, :2, 2]
        along = poses[t, :2, 2] + share[:, None, None] * (ends - poses[t, :2, 2])
        step = np.linalg.norm(points[t], axis=-1) / RESOLUTION / len(share)
        j, i = np.floor((along - ORIGIN[:2]) / RESOLUTION).astype(int).T
        np.add.at(beta, (i, j), np.broadcast_to(step[:, None], i.shape))
        j, i = np.floor((ends - ORIGIN[:2]) / RESOLUTION).astype(int).T
        np.add.at(alpha, (i[hit[t]], j[hit[t]]), e[t][hit[t]])
        np.add.at(beta, (i[hit[t]], j[hit[t]]), 1 - e[t][hit[t]])
    with np.errstate(invalid="ignore"):
        p = (alpha / (alpha + beta)).astype(np.float32)
    return OccupancyMap(p, ORIGIN, RESOLUTION, alpha, beta)


RULE = RangeRule(12.0, "12 m repeats (919 x)", "unusable", 12.0, 0.0)
SOURCE = {
    "path": "logs/hall <1>.clf",
    "format": "CARMEN FLASER",
    "sensors": [
        {
            "name": "FLASER",
            "beams_per_scan": 181,
            "ranges": asdict(RULE),
            "start_angle": -1.5708,
        }
    ],
    "ignored": {},
    "skipped_odometry": {"stamp goes back": {"count": 2, "lines": [88, 91]}},
    "skipped": {
        "truncated record": {"count": 1, "lines": [1700]},
        "<script>alert(1)</script>": {"count": 40, "lines": list(range(203, 243))},
    },
}

LEARNED = {
    "scatter": 0.0167,
    "p_static": 0.8731,
    "static_occupied": [{"value": 0.998, "share": 0.75}, {"value": 0.9, "share": 0.25}],
    "mover_occupied": [{"value": 0.01, "share": 0.9}, {"value": 0.15, "share": 0.1}],
    "mover_seconds": [
        {"value": 0.5, "share": 0.6},
        {"value": 3.0, "share": 0.3},
        {"value": 45.0, "share": 0.1},
    ],
}


def _graph(poses):
    """Every tenth scan, and a loop from the last to the first."""
    scans = np.append(np.arange(0, len(poses) - 1, 10), len(poses) - 1)
    at = poses[scans]
    pairs = [(k, k + 1) for k in range(len(scans) - 1)] + [(0, len(scans) - 1)]
    spread = np.array([[4e-4, 1e-4, 2e-5], [1e-4, 2e-4, -1e-5], [2e-5, -1e-5, 1e-5]])
    found = [Constraint(i, j, inverse(at[i]) @ at[j], spread) for i, j in pairs]
    return PoseGraph(scans, at, found)


def made_up_objects(recording, p_static, scan):
    """Two things that go straight on, and the beams on moving things shared among them."""
    beams = np.flatnonzero(p_static < 0.3)
    out = []
    for number, (xy, v) in enumerate((((2.0, 1.0), (0.5, 0.25)), ((9.0, 4.0), (-0.4, 0.0)))):
        mine = beams[number::2]
        scans = np.unique(scan[mine])
        stamp_ns = recording.stamp_ns[scans]
        seconds = 1e-9 * (stamp_ns - stamp_ns[0])
        way = np.array(xy) + seconds[:, None] * np.array(v)
        velocity = np.tile(v, (len(scans), 1))
        out.append(MovingObject(number, scans, stamp_ns, way, velocity, (0.5, 0.3), mine, 0.9))
    return out


def made_up_evidence(occupancy):
    """Looks that lengths and hits would make, every second one clear."""
    looks = np.ceil(occupancy.alpha + occupancy.beta).astype(np.uint16)
    clear = looks // 2
    return Coverage(looks, clear, (clear < 3) & ~np.isnan(occupancy.p_occupied), 3, 0.3)


@pytest.fixture(scope="session")
def section():
    """A function: the section of a report with a heading; empty where there is none.

    Sections for experts are closed details.
    """

    def cut(html, heading):
        ends = {"h2": "section", "h3": "details"}
        for level, end in ends.items():
            found = re.search(f"<{level}[^>]*>{heading}</{level}>.*?</{end}>", html, re.DOTALL)
            if found:
                return f"<{end}>{'<summary>' * (end == 'details')}{found[0]}"
        return ""

    return cut


@pytest.fixture(scope="session")
def result():
    rng = np.random.default_rng(3)
    poses, points, hit, moving = _simulate(rng)
    T, N = hit.shape
    e = np.where(moving, rng.beta(1, 12, (T, N)), rng.beta(12, 1, (T, N)))
    first = np.where(rng.random((T, N)) < 0.5, e, 0.9)
    e, first = np.where(hit, e, 0.9), np.where(hit, first, 0.9)
    maps = {k: _count(poses, points, hit, v) for k, v in {"raw": 1 + 0 * e, 1: first, 3: e}.items()}

    points = points.astype(np.float32)
    points[5, 40:43], hit[5, 40:43], e[5, 40:43], first[5, 40:43] = np.nan, False, np.nan, np.nan
    recording = Recording(
        stamp_ns=1_300_000_000_123_456_789 + np.arange(T, dtype=np.int64) * 200_000_001,
        offset=np.arange(T + 1, dtype=np.int64) * N,
        points=points.reshape(-1, 2),
        hit=hit.reshape(-1),
        T_base_sensor=matrix([0.0], [0.0], [0.0]),
        sensor=np.zeros(T, np.int32),
        T_odom_base=None,
        source=Source.from_dict(SOURCE),
    )
    world = points @ np.swapaxes(poses[:, :2, :2], 1, 2) + poses[:, None, :2, 2]
    world = np.where(hit[..., None], world, np.nan).reshape(-1, 2)
    labels = {number: v.reshape(-1).astype(np.float32) for number, v in ((1, first), (3, e))}
    window = choose_window(extent(maps[3]), maps[3].resolution, world[labels[3] < 0.5], 8.0)
    objects = made_up_objects(recording, e.reshape(-1), np.repeat(np.arange(T), N))
    none = (np.eye(3), np.eye(3))  # pose and covariance of loops
    return FakeResult(
        objects=objects,
        traffic=compute_flow_map(objects),
        recording=recording,
        options=FakeOptions(),
        iterations=[
            IterationRecord(1, -41234.5, -40211.0, 1.0, 1.9),
            IterationRecord(2, -32100.25, -31500.5, 0.08, 1.8),
            IterationRecord(3, -30800.0, -30300.0, 0.01, 1.7),
            IterationRecord(4, -30950.0, float("nan"), 0.002, 1.7),
        ],
        snapshots=[
            snapshot(n, maps[k], world[labels[k] < 0.5], window)
            for n, k in ((1, 1), (2, 1), (3, 3))
        ],
        poses=poses,
        p_static=labels[3],
        map=maps[3],
        raw_map=maps["raw"],
        evidence=made_up_evidence(maps[3]),
        best_iteration=3,
        converged=True,
        warnings=["the odometry stalls at line 88 & <after>"],
        learned=LEARNED,
        loops=[
            LoopClosure(2, 40, *none, 0.75),
            LoopClosure(4, 42, *none, 0.5, "explains too little"),
            LoopClosure(5, 44, *none, 0.9, "other loops disagree"),
            LoopClosure(6, 46, *none, 0.25, "explains too little"),
        ],
        graph=_graph(poses),
        doubts=Diagnostics(
            [7],
            [7, 9],
            breaks=[20],
            ambiguous=[31],
            bare_stretches=[BareStretch(12, 19, 3.25, 0.4)],
        ),
        stages={
            "read": {"seconds": 0.21, "cpu_seconds": 0.2, "peak_memory_bytes": 41_000_000},
            "em": {"seconds": 7.1, "cpu_seconds": 13.5, "peak_memory_bytes": 96_000_000},
            "map": {"seconds": 0.02, "cpu_seconds": 0.02, "peak_memory_bytes": 97_000_000},
        },
    )
