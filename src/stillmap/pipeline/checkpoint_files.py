"""How far a run has come, as values for JSON and flat arrays, and back again.

What two runs must have in common for one to go on from the other.
"""

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import em, slam
from stillmap.core.arrays import iter_blocks
from stillmap.core.config import to_dict
from stillmap.core.errors import InputError
from stillmap.core.json import to_jsonable, version
from stillmap.core.recording import Recording
from stillmap.pipeline.em_loop import Reached
from stillmap.pipeline.options import Options
from stillmap.pipeline.progress import Best, IterationRecord, Loop
from stillmap.pipeline.snapshots import Snapshot
from stillmap.slam.pose_graph import Constraint

Arrays = dict[str, NDArray[Any]]

Float = NDArray[np.float64]

_CHANGED = [field.name for field in dataclasses.fields(em.ChangedCells)]

_DOUBTS = [field.name for field in dataclasses.fields(slam.Diagnostics)]


def packed(loop: Loop) -> tuple[dict[str, Any], Arrays]:
    """Values and arrays by names; what is known of each beam after iteration k is "e-k"."""
    best, reached = loop.kept, loop.reached
    if reached is None or reached.mapped is None:
        raise ValueError("loop: no iteration has been run")
    arrays: Arrays = {
        f"e-{reached.number}": reached.p_static,
        f"e-{best.number}": best.p_static,
        f"e-{best.number - 1}": best.weights,
    }
    values = {
        "records": [dataclasses.asdict(record) for record in loop.records],
        "snapshots": [_snapshot_packed(one, arrays) for one in loop.snapshots.values()],
        "window": loop.window,
        "finished": loop.finished,
        "reached": {"number": reached.number, **_way_packed("reached", reached.mapped, arrays)},
        "best": _best_packed(best, arrays),
    }
    return values, arrays


def unpacked(
    values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], options: Options
) -> Loop:
    """The loop that `packed` was given."""
    best, reached = values["best"], values["reached"]
    way = _way("reached", reached, arrays)
    D = way["poses"].shape[-1] - 1
    grid = em.make_grid(D, options.slam.resolution)
    doubts = way.pop("doubts")
    lists = {name: getattr(doubts, name) for name in _DOUBTS}
    number = reached["number"]
    return Loop(
        options,
        records=[IterationRecord(**record) for record in values["records"]],
        snapshots={one["number"]: _snapshot(one, arrays) for one in values["snapshots"]},
        window=None if values["window"] is None else tuple(values["window"]),
        best=_best(best, arrays),
        finished=values["finished"],
        reached=Reached(number, arrays[f"e-{number}"], slam.MStepResult(grid=grid, **way, **lists)),
    )


def _best_packed(best: Best, arrays: Arrays) -> dict[str, Any]:
    values = {"number": best.number, "bound": best.bound, "learned": best.learned}
    if best.occupied is not None:
        arrays["best.cells"] = best.occupied.cells
        arrays["best.p_occupied"] = best.occupied.p_occupied
        values["free_prior"] = best.occupied.free_prior
    if best.no_return is not None:
        arrays["best.stops"] = best.no_return.stops
        values["beyond"] = best.no_return.beyond
    if best.changed is not None:
        arrays |= {f"best.changed.{name}": getattr(best.changed, name) for name in _CHANGED}
    if best.ground is not None:
        arrays |= {"best.ground.z": best.ground.z, "best.ground.corner": best.ground.corner}
        values |= {"sensor_height": best.ground.sensor, "ground_seen": best.ground.seen}
    return {**values, **_way_packed("best", best, arrays)}


def _best(values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Best:
    number, occupied, no_return = values["number"], None, None
    if "free_prior" in values:
        cells, p_occupied = arrays["best.cells"], arrays["best.p_occupied"]
        occupied = em.CellProbabilities(cells, p_occupied, values["free_prior"])
    if "beyond" in values:
        no_return = em.NoReturnModel(arrays["best.stops"], values["beyond"])
    changed = None
    if f"best.changed.{_CHANGED[0]}" in arrays:
        changed = em.ChangedCells(**{name: arrays[f"best.changed.{name}"] for name in _CHANGED})
    ground = None
    if "sensor_height" in values:
        z, corner = arrays["best.ground.z"], arrays["best.ground.corner"]
        ground = em.GroundMap(z, corner, values["sensor_height"], values["ground_seen"])
    return Best(
        number=number,
        bound=values["bound"],
        weights=arrays[f"e-{number - 1}"],
        p_static=arrays[f"e-{number}"],
        occupied=occupied,
        learned=values["learned"],
        no_return=no_return,
        changed=changed,
        ground=ground,
        **_way("best", values, arrays),
    )


def _way_packed(name: str, way: Best | slam.MStepResult, arrays: Arrays) -> dict[str, Any]:
    """Poses, and what is known of them."""
    for part in ("poses", "covariance", "explained"):
        arrays[f"{name}.{part}"] = getattr(way, part)
    D = way.poses.shape[-1] - 1
    pose, covariance = (D + 1, D + 1), (way.covariance.shape[-1],) * 2
    arrays[f"{name}.loops.scans"] = _stacked([[c.earlier, c.later] for c in way.loops], (2,), int)
    arrays[f"{name}.loops.T"] = _stacked([c.T for c in way.loops], pose)
    arrays[f"{name}.loops.covariance"] = _stacked([c.covariance for c in way.loops], covariance)
    arrays[f"{name}.loops.explained"] = _stacked([c.explained for c in way.loops], ())
    if way.graph is not None:
        relations = way.graph.constraints
        between = [[r.first, r.second] for r in relations]
        arrays[f"{name}.graph.scans"] = way.graph.keyframes
        arrays[f"{name}.graph.poses"] = way.graph.poses
        arrays[f"{name}.graph.between"] = _stacked(between, (2,), int)
        arrays[f"{name}.graph.T"] = _stacked([r.T for r in relations], pose)
        arrays[f"{name}.graph.covariance"] = _stacked([r.covariance for r in relations], covariance)
    return {
        "doubts": {field: getattr(way.diagnostics, field) for field in _DOUBTS},
        "refused": [closure.refused for closure in way.loops],
        "has_graph": way.graph is not None,
    }


def _way(
    name: str, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> dict[str, Any]:
    def rows(*parts: str) -> Iterator[Any]:
        return zip(*(arrays[f"{name}.{part}"] for part in parts), strict=True)

    of_loops = rows("loops.scans", "loops.T", "loops.covariance", "loops.explained")
    graph = None
    if values["has_graph"]:
        graph = slam.PoseGraph(
            arrays[f"{name}.graph.scans"],
            arrays[f"{name}.graph.poses"],
            [
                Constraint(int(between[0]), int(between[1]), T, covariance)
                for between, T, covariance in rows("graph.between", "graph.T", "graph.covariance")
            ],
        )
    return {
        **{part: arrays[f"{name}.{part}"] for part in ("poses", "covariance", "explained")},
        "doubts": slam.Diagnostics(**values["doubts"]),
        "loops": [
            slam.LoopClosure(int(scans[0]), int(scans[1]), T, covariance, float(explained), refused)
            for (scans, T, covariance, explained), refused in zip(
                of_loops, values["refused"], strict=True
            )
        ],
        "graph": graph,
    }


def _snapshot_packed(one: Snapshot, arrays: Arrays) -> dict[str, Any]:
    arrays[f"snapshot-{one.number}.p_occupied"] = one.p_occupied
    arrays[f"snapshot-{one.number}.points"] = one.dynamic_points
    return {"number": one.number, "origin": one.origin, "resolution": one.resolution}


def _snapshot(values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Snapshot:
    number = values["number"]
    return Snapshot(
        number,
        arrays[f"snapshot-{number}.p_occupied"],
        tuple(values["origin"]),
        values["resolution"],
        arrays[f"snapshot-{number}.points"],
    )


def _stacked(rows: list[Any], row: tuple[int, ...], dtype: type = float) -> NDArray[Any]:
    return np.array(rows, dtype).reshape(len(rows), *row)


_NO_MATTER = ("threads",)  # options on which no byte of the result depends


def identity(recording: Recording, options: Options, poses: Float | None) -> dict[str, Any]:
    """What is mapped, and how, JSON-able: hashes of the arrays, whatever files they came from."""
    arrays: dict[str, NDArray[Any] | None] = {
        "stamps": recording.stamp_ns,
        "scans": recording.offset,
        "beams": recording.points,
        "returns": recording.hit,
        "times of beams": recording.beam_time,
        "places of sensors": recording.T_base_sensor,
        "sensors of scans": recording.sensor,
        "odometry": recording.T_odom_base,
        "given poses": poses,
    }
    chosen = {name: value for name, value in to_dict(options).items() if name not in _NO_MATTER}
    return {
        "version": version(),
        "options": to_jsonable(chosen),
        "arrays": {name: None if a is None else _hash(a) for name, a in arrays.items()},
    }


def require_same(before: dict[str, Any], now: dict[str, Any], where: str) -> None:
    """Refuse to go on from a run of something else.

    Raises:
        InputError: it names what differs.
    """
    if before == now:
        return
    differ = []
    if before["version"] != now["version"]:
        differ.append(f"version {before['version']} made it, this is {now['version']}")
    old, new = _flat(before["options"]), _flat(now["options"])
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            differ.append(f"{name} was {old.get(name)!r}, is {new.get(name)!r}")
    names = [name for name, a in now["arrays"].items() if before["arrays"].get(name) != a]
    if names:
        differ.append(f"another recording: {', '.join(names)} differ")
    raise InputError(
        f"cannot be resumed: {'; '.join(differ) or 'its description differs'}",
        where=where,
        hint="give the same as before, or start anew without --resume",
    )


def _hash(array: NDArray[Any]) -> str:
    found = hashlib.blake2b(f"{array.dtype.str} {array.shape}".encode(), digest_size=16)
    for block in iter_blocks(array):
        found.update(np.ascontiguousarray(array[block]).reshape(-1).view(np.uint8).data)
    return found.hexdigest()


def _flat(options: dict[str, Any], section: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in options.items():
        if isinstance(value, dict):
            out |= _flat(value, f"{section}{key}.")
        else:
            out[f"{section}{key}"] = value
    return out
