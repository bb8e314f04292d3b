"""`stillmap map` on one ring of a 3D laser scanner in traffic, without odometry.

python benchmarks/rings.py PACK ... [--elevation DEG] [--turn S] [--keep DIR]
    [-- FLAGS FOR stillmap map]

PACK is NAME.npz: `xyz_2p5mm` (N, 3) int16 end points of all sweeps in the scanner's frame, ring by
ring and within a ring by azimuth from 0 up; `offset` (T+1,) where each sweep begins; where there
are, `t` (T,) seconds, `pose` (T, 4, 4) reference poses of the scanner, and `label` (N,): 1 moving,
0 static, -1 unknown. Without `t` a sweep takes 0.1 s.

Of the rings that look within half a degree of --elevation, the one that hits something most often
becomes a recording in the plane, of 900 beams a sweep. --turn gives the beams times: how long the
scanner takes for a turn, negative where it turns clockwise; at the stamp it looks ahead.

End drift: how far the way from the first to the last pose is off, in % of the path. Labels count
between 2.5 and 50 m.
"""

import argparse
import itertools
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pairs import timed_poses
from real_logs import split, stillmap
from tables import markdown

from stillmap import io
from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.eval.readers import read_planar_trajectory
from stillmap.eval.trajectory import compute_absolute_errors

Float = NDArray[np.float64]

BEAMS = 900
LEVEL = np.radians(0.5)
FAR = 10.0  # m from where on the height at which a ring leaves the scanner matters little
NO_RETURN = 80.0  # m: packs hold nothing beyond
LABELLED = (2.5, 50.0)  # m
_UNIT = 0.0025  # m
_PERIOD = 0.1  # s


@dataclass(frozen=True, eq=False)
class Ring:
    """One ring of a pack.

    Attributes:
        recording: in the plane, BEAMS a sweep.
        label: (M,) of each beam's end point; -1 where it is unknown or nothing was hit.
        reference: (T, 3, 3) poses; None where there are none.
        elevation: rad, where the ring looks.
    """

    io: Recording
    label: NDArray[np.int8]
    reference: Float | None
    elevation: float


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("packs", type=Path, nargs="+", metavar="PACK")
    p.add_argument("--elevation", type=float, default=0.0, metavar="DEG")
    p.add_argument("--turn", type=float, default=0.0, metavar="S")
    p.add_argument("--keep", type=Path, metavar="DIR", help="for recordings and results")
    own, flags = split(sys.argv[1:])
    args = p.parse_args(own)
    with tempfile.TemporaryDirectory() as scratch:
        lines = []
        for pack in args.packs:
            ring = ring_of(pack, np.radians(args.elevation), args.turn)
            lines.append([pack.stem, *row(ring, (args.keep or Path(scratch)) / pack.stem, flags)])
    print(markdown(_HEADER, lines))


def ring_of(pack: Path, elevation: float, turn: float = 0.0) -> Ring:
    """The ring of a pack that hits most, of those that look about so high in radians.

    Args:
        pack: a file as described above.
        elevation: rad.
        turn: s that a turn of the scanner takes, negative clockwise; 0: no beam times.

    Raises:
        InputError: no ring looks there.
    """
    data = dict(np.load(pack))
    offset = data["offset"]
    sweeps = [_Sweep(data["xyz_2p5mm"][a:b]) for a, b in itertools.pairwise(offset)]
    number, looks = _chosen(sweeps, elevation, pack)
    T, angles = len(sweeps), _middles()
    points = np.tile(NO_RETURN * np.stack([np.cos(angles), np.sin(angles)], axis=-1), (T, 1, 1))
    hit, label = np.zeros((T, BEAMS), bool), np.full((T, BEAMS), -1, np.int8)
    for k, sweep in enumerate(sweeps):
        at, beam = sweep.beams(number)
        points[k, beam], hit[k, beam] = sweep.xyz[at, :2], True
        if "label" in data:
            label[k, beam] = data["label"][offset[k] + at]
    seconds = data.get("t", _PERIOD * np.arange(T))
    flat = Recording(
        stamp_ns=np.round(seconds * 1e9).astype(np.int64),
        offset=np.arange(T + 1, dtype=np.int64) * BEAMS,
        points=points.reshape(-1, 2).astype(np.float32),
        hit=hit.ravel(),
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(T, np.int32),
        T_odom_base=None,
        source={"format": "ring of a 3D scanner", "path": str(pack)},
        beam_time=np.tile(angles * turn / (2 * np.pi), T).astype(np.float32) if turn else None,
    )
    return Ring(flat, label.ravel(), _flat(data["pose"]) if "pose" in data else None, looks)


class _Sweep:
    """End points (N, 3) in metres, and which ring each is of."""

    def __init__(self, xyz_2p5mm: NDArray[np.int16]) -> None:
        self.xyz = xyz_2p5mm * np.float32(_UNIT)
        self.azimuth = np.arctan2(self.xyz[:, 1], self.xyz[:, 0])
        around = self.azimuth % (2 * np.pi)
        # rings begin ahead and go once around
        self.ring = np.concatenate([[0], np.cumsum(np.diff(around) < -np.pi)])[: len(around)]

    def elevations(self) -> Float:
        """(R,) rad of each ring, NaN where it sees nothing far away."""
        metres = np.hypot(self.xyz[:, 0], self.xyz[:, 1])
        up = np.where(metres > FAR, np.arctan2(self.xyz[:, 2], metres), np.nan)
        ends = np.searchsorted(self.ring, np.arange(self.ring[-1] + 2))
        looks = [up[a:b][metres[a:b] > FAR] for a, b in itertools.pairwise(ends)]
        return np.array([np.median(far) if len(far) else np.nan for far in looks])

    def beams(self, number: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """End points of a ring, and the beams that they become: the one nearest its middle each."""
        at = np.flatnonzero((self.ring == number) & self.xyz.any(axis=1))
        beam = ((self.azimuth[at] + np.pi) * BEAMS / (2 * np.pi)).astype(np.intp) % BEAMS
        off = np.abs(se2.wrap(self.azimuth[at] - _middles()[beam]))
        nearest = np.lexsort((off, beam))
        beam, first = np.unique(beam[nearest], return_index=True)
        return at[nearest[first]], beam


def _middles() -> Float:
    return (np.arange(BEAMS) + 0.5) * (2 * np.pi / BEAMS) - np.pi


def _chosen(sweeps: list[_Sweep], elevation: float, pack: Path) -> tuple[int, float]:
    """The ring, and where it looks."""
    looks = [sweep.elevations() for sweep in sweeps]
    rings = min(len(of_sweep) for of_sweep in looks)
    known = np.array([of_sweep[:rings] for of_sweep in looks])
    seen = np.isfinite(known).any(axis=0)
    median = np.full(rings, np.nan)
    median[seen] = np.nanmedian(known[:, seen], axis=0)
    level = np.flatnonzero(np.abs(median - elevation) <= LEVEL)
    if not len(level):
        raise InputError(f"no ring looks {np.degrees(elevation):g} degrees up", where=str(pack))
    hits = [sum(len(sweep.beams(number)[0]) for sweep in sweeps) for number in level]
    number = int(level[np.argmax(hits)])
    return number, float(median[number])


def _flat(poses: Float) -> Float:
    """(T, 3, 3) what poses in space (T, 4, 4) are from above."""
    return se2.matrix(poses[:, 0, 3], poses[:, 1, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))


_HEADER = (
    "pack",
    "ring, deg up",
    "scans",
    "hits",
    "path m",
    "ATE m",
    "end drift %",
    "called dynamic",
    "moving beams",
    "of them dynamic",
    "static beams",
    "of them dynamic",
    "iterations (best)",
    "CPU ms per scan",
)


def row(ring: Ring, out: Path, flags: list[str]) -> list[str]:
    """What `stillmap map` makes of a ring, in a folder of its own."""
    io.write(ring.recording, out / "recording", overwrite=True)
    arguments = ["map", str(out / "recording"), "-o", str(out / "map"), "--no-odometry"]
    _, cpu = stillmap(*arguments, "--overwrite", "--quiet", *flags)
    run = json.loads((out / "map" / "run.json").read_text())
    p_static = np.load(out / "map" / "beams" / "p_static.npy")
    trajectory = read_planar_trajectory(out / "map" / "trajectory.tum")
    scans = ring.recording.n_scans
    return [
        f"{np.degrees(ring.elevation):.2f}",
        str(scans),
        f"{ring.recording.hit.mean():.3f}",
        *pose_columns(ring, trajectory),
        f"{np.mean(p_static[ring.recording.hit] < 0.5):.4f}",
        *label_columns(ring, p_static),
        f"{len(run['iterations'])} ({run['best_iteration']})",
        f"{1e3 * cpu / scans:.1f}",
    ]


def pose_columns(ring: Ring, trajectory: Float) -> list[str]:
    """Path, ATE, end drift of a trajectory (T, 4): t, x, y, theta."""
    if ring.reference is None:
        return ["-"] * 3
    known = timed_poses(ring.recording.stamp_ns, ring.reference)
    if not np.allclose(trajectory[:, 0], known[:, 0], atol=1e-3):
        raise InputError("stamps are not those of the recording", where="trajectory.tum")
    poses = se2.matrix(*trajectory[:, 1:].T)
    path = np.linalg.norm(np.diff(known[:, 1:3], axis=0), axis=1).sum()
    ways = [se2.inverse(T[0]) @ T[-1] for T in (poses, ring.reference)]
    drift = np.linalg.norm(ways[0][:2, 2] - ways[1][:2, 2])
    ate = compute_absolute_errors(poses, ring.reference).rmse
    return [f"{path:.1f}", f"{ate:.3f}", f"{100 * drift / path:.2f}"]


def label_columns(ring: Ring, p_static: NDArray[np.float32]) -> list[str]:
    """Beams that met something moving, those of them that are called so; the same of the rest."""
    metres = np.linalg.norm(ring.recording.points, axis=1)
    counts = (metres >= LABELLED[0]) & (metres < LABELLED[1]) & ring.recording.hit
    dynamic = p_static < 0.5
    out = []
    for value in (1, 0):
        of = counts & (ring.label == value)
        out += [str(int(of.sum())), f"{dynamic[of].mean():.4f}" if of.any() else "-"]
    return out


if __name__ == "__main__":
    main()
