"""Moving objects of live mapping at the time, against the truth.

python benchmarks/live_movers.py [--worlds hall corridor] [--seed 11] [--people N] [--beams N]

Recall: of the walkers (more than 0.3 m/s) within 15 m that reflect a beam of the scan, also of
those that have done so for a second; precision: of all movers that are told. A mover belongs to the
nearest person within 0.5 m. "nobody": movers and scans with any in the same world without people.
"""

import time

import numpy as np
from common import make_parser
from tables import markdown

from stillmap.core import se2
from stillmap.live.mapper import LiveMapper
from stillmap.live.movers import MoverTracker
from stillmap.live.replay import iter_beams
from stillmap.sim import scene_by_name, simulate

_REACH, _NEAR, _WALKING = 15.0, 0.5, 0.3  # m, m, m/s


def main() -> None:
    p = make_parser(__doc__)
    p.add_argument("--worlds", nargs="+", default=["hall", "corridor"])
    p.add_argument("--seed", type=int, default=11)
    p.add_argument("--people", type=int, help="default: as many as the world has")
    p.add_argument("--beams", type=int, help="default: as many as the world's laser has")
    args = p.parse_args()
    laser = {} if args.beams is None else {"laser": {"beams": args.beams}}
    lines = []
    for world in args.worlds:
        crowd = {} if args.people is None else {"crowd": {"people": args.people}}
        line = _score(*_run(simulate(scene_by_name(world, laser | crowd), args.seed)))
        nobody = scene_by_name(world, laser | {"crowd": {"people": 0}})
        empty = simulate(nobody, args.seed)
        alone = [update.movers for update in _run(empty)[1]]
        numbers = {mover.number for movers in alone for mover in movers}
        lines.append([world, *line, f"{len(numbers)} / {sum(map(bool, alone))}"])
        print(" | ".join(lines[-1]), flush=True)
    titles = ["world", "recall", "after 1 s", "precision", "m/s off", "m off", "ms", "nobody"]
    print(markdown(titles, lines))


def _run(simulation):
    """The simulation, the update of every scan, and the CPU ms of tracking for each."""
    recording, updates, ms = simulation.recording, [], 0.0
    tracker = MoverTracker(2)
    with LiveMapper({"threads": 1}) as mapper:
        for t, beams in enumerate(iter_beams(recording)):
            odometry = None if recording.T_odom_base is None else recording.T_odom_base[t]
            updates.append(mapper.push(beams, odometry))
            start = time.thread_time()
            tracker.add(beams, updates[-1].pose, updates[-1].p_static)
            tracker.movers(np.eye(3))
            ms += 1e3 * (time.thread_time() - start)
    return simulation, updates, ms / recording.n_scans


def _score(simulation, updates, ms: float) -> list[str]:
    recording, truth = simulation.recording, simulation.truth
    seconds = 1e-9 * (recording.stamp_ns - recording.stamp_ns[0])
    velocity = np.gradient(truth.movers[..., :2], seconds, axis=0)
    since = np.full(truth.movers.shape[1], np.inf)  # in sight
    seen, told, right = np.zeros(2, int), 0, 0
    found, errors = np.zeros(2, int), []
    for t, update in enumerate(updates):
        # in the frame of the robot: how far off its pose is is told elsewhere
        T, P = se2.inverse(truth.T_world_base[t]), se2.inverse(update.pose)
        people = truth.movers[t, :, :2] @ T[:2, :2].T + T[:2, 2]
        at = np.array([m.position for m in update.movers]).reshape(-1, 2) @ P[:2, :2].T + P[:2, 2]
        speed = np.linalg.norm(velocity[t], axis=1)
        count = np.bincount(
            truth.mover[recording.beams_of(t)].clip(-1) + 1, minlength=len(since) + 1
        )
        since = np.where(count[1:] > 0, np.minimum(since, seconds[t]), np.inf)
        walks = (count[1:] > 0) & (np.linalg.norm(people, axis=1) < _REACH) & (speed > _WALKING)
        late = walks & (seconds[t] - since >= 1.0)
        off = np.linalg.norm(at[:, None] - people, axis=2)
        told, right = told + len(at), right + int((off.min(axis=1, initial=np.inf) < _NEAR).sum())
        pairs = dict(_pair(off))
        seen += walks.sum(), late.sum()
        for k in set(np.flatnonzero(walks)) & pairs.keys():
            found += 1, late[k]
            mover = update.movers[pairs[k]]
            errors.append((np.linalg.norm(mover.velocity) - speed[k], off[pairs[k], k]))
    speed_error, error = np.median(np.abs(errors), axis=0)
    shares = [*(found / seen), right / told]
    return [f"{s:.3f}" for s in shares] + [f"{speed_error:.3f}", f"{error:.3f}", f"{ms:.2f}"]


def _pair(off):
    """Person and mover, the nearest ones first, each once."""
    free = off.copy()
    while free.size and free.min() < _NEAR:
        mover, person = np.unravel_index(free.argmin(), free.shape)
        yield person, mover
        free[mover], free[:, person] = np.inf, np.inf


if __name__ == "__main__":
    main()
