"""Drift of routes without a loop, with and without headings aligned by the directions of walls.

python benchmarks/open_routes.py logs LOGS [--metres 80] [--first 0]
python benchmarks/open_routes.py worlds [--cases corridor-40-once ...] [--seeds 2 3 4]
    [--askew bend|wing|random:DEGREES ...]

logs: pieces of recorded logs, each mapped by itself, against the poses of the whole log, whose
loops are closed, mapped without alignment. worlds: simulated runs against the truth; --askew bends
the world by DEGREES from end to end, turns its second half, or turns every 10 m of it at random.
Printed are means: ATE in m, and the standard deviation of the heading in degrees.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from cases import chosen
from common import options_of
from numpy.typing import NDArray
from session_laps import select_scans

import stillmap
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.eval.trajectory import align
from stillmap.sim import Scene, simulate
from stillmap.slam import loop_closure

Float = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]
_STRETCH, _EDGE = 10.0, 0.5  # m that are turned alike, and of a wall after it was bent
_CASES = ("corridor-40-once", "office-10", "warehouse-30-legs", "hall-15", "street-empty")


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = p.add_subparsers(required=True)
    logs = commands.add_parser("logs")
    logs.add_argument("folder", type=Path)
    logs.add_argument("--metres", type=float, default=80.0)
    logs.add_argument("--first", type=float, default=0.0, help="m of travel before the first piece")
    logs.set_defaults(run=compare_logs)
    worlds = commands.add_parser("worlds")
    worlds.add_argument("--cases", nargs="+", default=list(_CASES))
    worlds.add_argument("--seeds", nargs="+", type=int, default=[2, 3, 4])
    worlds.add_argument("--askew", nargs="+", default=["bend:0"], metavar="HOW:DEGREES")
    worlds.set_defaults(run=compare_worlds)
    args = p.parse_args()
    print("| route | runs | ATE without, m | with | heading without, deg | with |")
    print("|---|---|---|---|---|---|")
    args.run(args)


def compare_logs(args: argparse.Namespace) -> None:
    for path in sorted(args.folder.glob("*.clf.gz")):
        recording = stillmap.read(path)
        reference = estimate(recording, aligned=False)
        steps = np.hypot(*np.diff(reference[:, :2, 2], axis=0).T)
        travelled = np.append(0.0, steps.cumsum())
        pairs = []
        for start in np.arange(args.first, travelled[-1] - 0.6 * args.metres, args.metres):
            a, b = np.searchsorted(travelled, [start, start + args.metres])
            piece = select_scans(recording, np.arange(a, b))
            pairs.append(errors(piece, reference[a:b]))
        show(path.name.removesuffix(".clf.gz"), pairs)


def compare_worlds(args: argparse.Namespace) -> None:
    for case in chosen(args.cases):
        for how in args.askew:
            simulations = [
                simulate(bend_world(case.build(), how, seed), seed) for seed in args.seeds
            ]
            show(
                case.name if how.endswith(":0") else f"{case.name}, {how}",
                [errors(one.recording, one.truth.T_world_base) for one in simulations],
            )


def estimate(recording: Recording, aligned: bool) -> Float:
    options = options_of("stillmap", ())
    if aligned:
        return stillmap.build(recording, options).poses
    with mock.patch.object(loop_closure, "align_headings", lambda _, __, graph, ___: graph):
        return stillmap.build(recording, options).poses


def errors(recording: Recording, truth: Float) -> Float:
    """(2, 2) ATE in m and heading in degrees, without and with alignment."""
    rows = []
    for aligned in (False, True):
        poses = estimate(recording, aligned)
        off = se2.parameters(se2.inverse(truth) @ align(poses, truth) @ poses)
        ate = np.sqrt(np.square(off[:, :2]).sum(axis=1).mean())
        rows.append([ate, np.degrees(off[:, 2].std())])
    return np.array(rows)


def show(name: str, pairs: list[Float]) -> None:
    (ate, heading), (ate_with, heading_with) = np.mean(pairs, axis=0)
    print(
        f"| {name} | {len(pairs)} | {ate:.4f} | {ate_with:.4f} | {heading:.3f} "
        f"| {heading_with:.3f} |",
        flush=True,
    )


@dataclass(frozen=True, eq=False)
class Bend:
    """The x axis of a world, bent.

    Attributes:
        x: (N,) m, before.
        theta: (N,) rad, direction of the axis there.
        axis: (2, N) m, where it lies then.
        middle: m, y of the axis before.
    """

    x: Float
    theta: Float
    axis: Float
    middle: float

    @classmethod
    def of_world(cls, scene: Scene, how: str, seed: int) -> "Bend":
        kind, degrees = how.split(":")
        angle, walls = np.radians(float(degrees)), np.array(scene.walls)
        first, last = walls[:, ::2].min() - 5.0, walls[:, ::2].max() + 5.0
        x, step = np.linspace(first, last, 4000, retstep=True)
        if kind == "bend":
            theta = angle * (x - first) / (last - first)
        elif kind == "wing":
            theta = angle * np.clip(0.5 * x - 0.25 * (first + last), 0.0, 1.0)
        else:
            places = np.arange(first, last + _STRETCH, _STRETCH)
            rng = np.random.default_rng(seed)
            theta = np.interp(x, places, rng.normal(0.0, angle, len(places)))
        middle = float(walls[:, 1::2].mean())
        axis = np.zeros((2, len(x)))
        axis[:, 1:] = step * np.array([np.cos(theta), np.sin(theta)])[:, :-1].cumsum(axis=1)
        return cls(x, theta, axis + np.array([[first], [middle]]), middle)

    def move(self, points: Float) -> Float:
        """Points (..., 2) of the bent world."""
        at, aside = points[..., 0], points[..., 1] - self.middle
        theta = np.interp(at, self.x, self.theta)
        axis = np.stack([np.interp(at, self.x, row) for row in self.axis], axis=-1)
        normal = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
        return np.asarray(axis + aside[..., None] * normal)

    def move_points(self, points: Rows) -> Rows:
        return tuple(map(tuple, self.move(np.array(points, float).reshape(-1, 2)).tolist()))

    def move_segments(self, segments: Rows) -> Rows:
        """Segments x0, y0, x1, y1, in parts that are short enough to bend."""
        out: list[tuple[float, ...]] = []
        for start, end in np.array(segments, float).reshape(-1, 2, 2):
            parts = max(1, int(np.ceil(np.linalg.norm(end - start) / _EDGE)))
            share = np.linspace(0.0, 1.0, parts + 1)[:, None]
            p = self.move((1.0 - share) * start + share * end)
            out += map(tuple, np.concatenate([p[:-1], p[1:]], axis=1).tolist())
        return tuple(out)


def bend_world(scene: Scene, how: str, seed: int) -> Scene:
    """The world bent along its x axis, without doors, things and vehicles; `:0`: as it is."""
    if how.endswith(":0"):
        return scene
    bend = Bend.of_world(scene, how, seed)
    changes: dict[str, Any] = {
        **{name: bend.move_segments(getattr(scene, name)) for name in ("walls", "glass", "kerbs")},
        **{name: bend.move_points(getattr(scene, name)) for name in ("route", "people_at")},
    }
    return replace(scene, **changes, leaves=(), things=(), lanes=())


if __name__ == "__main__":
    main()
