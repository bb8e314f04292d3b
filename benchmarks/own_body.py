"""Returns of the robot itself in 3D recordings: how many are found, and how many others are lost.

python benchmarks/own_body.py [--cases street-16 ...] [--seeds tuning|reporting] [--n-seeds 3]

Each case is simulated three times: with a robot that the lidar sees (the roof of a car, the top of
a cart or of a small robot), with one that it does not, and with the former standing still. Found is
the share of its returns that are left out; lost are returns of anything else.
"""

from typing import Any, NamedTuple

import numpy as np
from common import add_seed_arguments, make_parser, seeds_of
from tables import markdown

from stillmap.prepare import self_filter
from stillmap.sim import scene_by_name, simulate
from stillmap.sim.lidar import ROBOT

_CAR = {"roof_length": 4.0, "roof_width": 1.7, "roof_below": 0.35}
_CART = {"roof_length": 0.9, "roof_width": 0.7, "roof_below": 0.3, "z": 1.1, "low": -0.9}
_SMALL = {"roof_length": 0.6, "roof_width": 0.5, "roof_below": 0.2, "z": 0.7, "low": -0.6}
# worlds, channels, scans, and the robot
CASES: dict[str, tuple[str, int, int, dict[str, float]]] = {
    "street-16": ("street", 16, 150, _CAR),
    "street-jam-32": ("street-jam", 32, 200, _CAR),
    "crossing-32": ("crossing", 32, 150, _CAR),
    "street-turn-64": ("street-turn", 64, 150, _CAR),
    "warehouse-32": ("warehouse", 32, 500, _CART),
    "hall-32": ("hall", 32, 500, _SMALL),
    "corridor-32": ("corridor", 32, 500, _SMALL),
    "office-32": ("office", 32, 500, _SMALL),
    # a lidar at the height of a man, on a robot that is too small to be seen
    "hall-16": ("hall", 16, 500, {}),
    "corridor-16": ("corridor", 16, 500, {}),
    "office-16": ("office", 16, 500, {}),
}
_COLUMNS = 360
_STANDING = 1e-3  # m/s


class Outcome(NamedTuple):
    """Hits of one run: of the robot itself, how many of these are found, others, lost ones."""

    own: int
    found: int
    others: int
    lost: int


def outcome(world: str, seed: int, lidar: dict[str, Any], robot: dict[str, Any]) -> Outcome:
    """What is left out of one simulated run."""
    scene = scene_by_name(world, {"lidar": {"columns": _COLUMNS, **lidar}, "robot": robot})
    run = simulate(scene, seed)
    hit, own = run.recording.hit, run.truth.mover == ROBOT
    gone = hit & ~self_filter.remove_self_returns(run.recording).hit
    counts = (hit & own, gone & own, hit & ~own, gone & ~own)
    return Outcome(*(int(np.count_nonzero(one)) for one in counts))


def row(case: str, seeds: list[int]) -> list[str]:
    """The figures of a case over all seeds."""
    world, channels, scans, body = CASES[case]
    lidar = {"channels": channels, **body}
    seen = {**lidar, "sees_robot": True}
    standing = {"scans": min(scans, 150), "speed": _STANDING}
    runs = [
        [outcome(world, seed, *one) for seed in seeds]
        for one in ((seen, {"scans": scans}), (lidar, {"scans": scans}), (seen, standing))
    ]
    own, found, others, lost = np.sum(runs[0], axis=0)
    return [
        case,
        f"{100.0 * found / own:.2f}" if own else "",
        f"{100.0 * lost / others:.3f}",
        *(f"{sum(o.found + o.lost for o in one)}" for one in runs[1:]),
    ]


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE")
    add_seed_arguments(p)
    p.set_defaults(n_seeds=3)
    args = p.parse_args()
    lines = []
    for case in args.cases:
        lines.append(row(case, list(seeds_of(args))))
        print(*lines[-1], flush=True)
    header = ["world, channels", "found, %", "others lost, %", "lost, not seen", "lost, standing"]
    print(markdown(header, lines))


if __name__ == "__main__":
    main()
