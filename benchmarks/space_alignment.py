"""Sessions in 3D: alignment without a prior, ours and that of libraries, on simulated streets.

python benchmarks/space_alignment.py --data DIR [--streets street crossing] [--seeds 3]
    [--peers PYTHON] [--merge]

Each street has five sessions of 50 m: the same way twice, 25 m further on, and both the other way.
The first one is paired with each other one, and with one of another street, which must be refused.
Compared are alignments before any refinement by single sweeps; right is within 0.5 m and 5 degrees,
errors in the middle of a session's path. --peers: a Python that has kiss-matcher, map-closures or
both; they get the static points of the keyframes, of the second session turned and shifted at
random. --merge: also what `stillmap merge` makes of it.

Sessions, results and clouds are kept in DIR and used again. Times are CPU seconds of one thread;
those of ours begin with the maps of both sessions.
"""

import argparse
import functools
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import session_merging as merging
from common import make_parser
from numpy.typing import NDArray
from session_sets import STRETCHES, prepare_street
from tables import markdown

import stillmap
from stillmap.core import se2
from stillmap.io.trajectory import read_tum
from stillmap.places.grow import add_session, lift_alignment, start_place
from stillmap.places.inputs import SessionInput, keep_session
from stillmap.places.keyframes import Session
from stillmap.places.place import Place, fit_alignment
from stillmap.places.placement import find_placement
from stillmap.places.store import read_session
from stillmap.results.eval.trajectory import align

Float = NDArray[np.float64]

_RIGHT = (0.5, 5.0)  # m, degrees
_CLOUD_CELL = 0.1  # m, in which one point is kept
_FAR = 200.0  # m, within which a session is shifted
_RESOLUTION, _VOXEL_SIZE = 0.05, 0.15  # m, as of `stillmap merge`
OURS, MERGED = "ours", "ours, merged"


class Row(NamedTuple):
    """What a method made of a pair: errors are NaN of another street."""

    kind: str
    method: str
    accepted: bool
    metres: float
    degrees: float
    cpu: float


@dataclass(frozen=True, eq=False)
class Mapped:
    """A mapped session with its true poses (T, 4, 4), and its cloud."""

    session: Session
    truth: Float
    cloud: Path


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("--data", type=Path, required=True, help="folder for sessions and results")
    p.add_argument("--streets", nargs="+", default=["street", "crossing"])
    p.add_argument("--seeds", type=int, default=3)
    p.add_argument("--peers", metavar="PYTHON")
    p.add_argument("--merge", action="store_true")
    args = p.parse_args()
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    rows, files, about = [], [], []
    rng = np.random.default_rng(1)
    for kind, one, other in list_pairs(args):
        print(f"{kind}: {one} {other}", file=sys.stderr, flush=True)
        first, second = (load_session(args.data, path) for path in (one, other))
        rows += align_ours(kind, first, second, args.merge)
        turned, T = turn_cloud(second, rng)
        files.append([str(first.cloud), str(turned)])
        about.append((kind, first, second, T))
    if args.peers:
        rows += align_peers(args.peers, args.data, files, about)
    print(table(rows))


def list_pairs(args: argparse.Namespace) -> list[tuple[str, Path, Path]]:
    """Kind and both sessions of each pair."""
    pairs = []
    for seed in range(1, args.seeds + 1):
        folders = [prepare_street(args.data, name, seed) for name in args.streets]
        for folder in folders:
            for number, kind in enumerate(STRETCHES, 2):
                pairs.append((kind, folder / "session-1", folder / f"session-{number}"))
        for folder in folders[1:]:
            pairs.append(("another street", folders[0] / "session-1", folder / "session-1"))
    return pairs


@functools.cache
def load_session(data: Path, path: Path) -> Mapped:
    """A session, mapped where it was not."""
    name = f"{path.parent.name}-{path.name}"
    result, cloud = data / "results" / name, data / "clouds" / f"{name}.npy"
    if not (result / "run.json").exists():
        program = [*merging.STILLMAP, "map", str(path), "-o", str(result)]
        subprocess.run([*program, "--quiet", "--threads", "1"], check=True)
    if (data / "sessions" / name).exists():
        session = read_session(data / "sessions" / name, str(path))
    else:
        loaded = stillmap.load(result)
        source = SessionInput(name, loaded)
        session = keep_session(source, loaded, loaded.deskewed, data, stillmap.Options())
    if not cloud.exists():
        cloud.parent.mkdir(parents=True, exist_ok=True)
        np.save(cloud, static_points(session))
    return Mapped(session, read_tum(path / "truth/trajectory.tum")[1], cloud)


def static_points(session: Session) -> NDArray[np.float32]:
    """(N, 3) static points of the keyframes in the session's frame."""
    keyframes = session.keyframes
    beams = np.flatnonzero(keyframes.recording.hit & (keyframes.e > 0.5))
    points = keyframes.recording.end_points(beams, keyframes.poses)
    cells = np.floor(points / _CLOUD_CELL).astype(np.int64)
    _, at = np.unique(cells, axis=0, return_index=True)
    return points[np.sort(at)].astype(np.float32)


def turn_cloud(one: Mapped, rng: np.random.Generator) -> tuple[Path, Float]:
    """The cloud of a session in another frame, and the pose (4, 4) of its own frame in it."""
    T, planar = np.eye(4), se2.matrix(*rng.uniform(-_FAR, _FAR, 2), rng.uniform(-np.pi, np.pi))
    T[:2, :2], T[:2, 3] = planar[:2, :2], planar[:2, 2]
    path = one.cloud.with_name(one.cloud.stem + "-turned.npy")
    np.save(path, (np.load(one.cloud) @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
    return path, T


@functools.cache
def start(one: Mapped) -> Place:
    """A place of one session."""
    return start_place(one.session, _RESOLUTION, _VOXEL_SIZE, 1)


def align_ours(kind: str, one: Mapped, other: Mapped, with_merge: bool) -> list[Row]:
    place = start(one)
    begun = time.process_time()
    found = find_placement(place.sessions, other.session)
    cpu = time.process_time() - begun
    T = fit_alignment(other.session.node_poses, lift_alignment(place, other.session, found))
    rows = [Row(kind, OURS, not found.refused, *errors(kind, T, one, other), cpu)]
    if with_merge:
        begun = time.process_time()
        grown, why = add_session(place, other.session, 1)
        cpu = time.process_time() - begun
        if not why:
            T = fit_alignment(other.session.poses, grown.sessions[1].poses)
        rows.append(Row(kind, MERGED, not why, *errors(kind, T, one, other), cpu))
    return rows


def align_peers(
    python: str,
    data: Path,
    files: list[list[str]],
    about: Sequence[tuple[str, Mapped, Mapped, Float]],
) -> list[Row]:
    pairs, out = data / "pairs.json", data / "peers.json"
    pairs.write_text(json.dumps(files))
    worker = Path(__file__).with_name("space_alignment_worker.py")
    subprocess.run([python, str(worker), str(pairs), str(out)], check=True)
    rows = []
    for one in json.loads(out.read_text()):
        kind, first, second, T = about[one["pair"]]
        off = errors(kind, np.array(one["T"]) @ T, first, second)
        rows.append(Row(kind, one["method"], one["accepted"], *off, one["cpu"]))
    return rows


def errors(kind: str, T: Float, one: Mapped, other: Mapped) -> tuple[float, float]:
    """Metres and degrees, of the pose (4, 4) of one session's frame in the other's."""
    if kind not in STRETCHES:
        return float("nan"), float("nan")
    T_world = align(one.session.poses, one.truth), align(other.session.poses, other.truth)
    off = se2.inverse(T_world[1]) @ T_world[0] @ T
    middle = other.session.poses[:, :3, 3].mean(axis=0)
    cosine = np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
    metres = np.linalg.norm(off[:3, :3] @ middle + off[:3, 3] - middle)
    return float(metres), float(np.degrees(np.arccos(cosine)))


def table(rows: Sequence[Row]) -> str:
    """A line per method, and how many pairs of each kind it got right."""
    lines = []
    for method in dict.fromkeys(row.method for row in rows):
        own = [row for row in rows if row.method == method]
        true, false = (
            [row for row in own if (row.kind in STRETCHES) == is_true] for is_true in (True, False)
        )
        right = [row for row in true if row.accepted and is_right(row)]
        counts = [f"{sum(r.kind == kind for r in right)}" for kind in STRETCHES]
        wrong = sum(row.accepted and not is_right(row) for row in true)
        lines.append([method, f"{len(right)} of {len(true)}", *counts, str(wrong)])
        lines[-1] += [
            f"{sum(row.accepted for row in false)} of {len(false)}",
            spread([row.metres for row in right], ".3f"),
            spread([row.degrees for row in right], ".2f"),
            spread([row.cpu for row in own], ".1f"),
        ]
    titles = ["alignment", "right", *STRETCHES, "wrong", "another street accepted"]
    return markdown([*titles, "m: median (max)", "degrees", "CPU s"], lines)


def is_right(row: Row) -> bool:
    return row.metres < _RIGHT[0] and row.degrees < _RIGHT[1]


def spread(values: Sequence[float], form: str) -> str:
    return f"{np.median(values):{form}} ({max(values):{form}})" if values else "-"


if __name__ == "__main__":
    main()
