"""The folder of a place: everything that the result of one recording has, and its sessions."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import write_npy, write_npz
from stillmap.core.input_files import read_bytes
from stillmap.core.json import write_json
from stillmap.core.local_frame import LocalFrame
from stillmap.core.short_repr import ShortRepr
from stillmap.io.trajectory import MAX_BYTES, write_tum
from stillmap.places.evidence import Evidence
from stillmap.places.inputs import TIES
from stillmap.places.place import Place, PlacedSession, Refusal
from stillmap.places.place_change import PlaceChange, change_cells, change_records
from stillmap.places.place_graph import Tie
from stillmap.places.shown_state import ShownState, changed_cell_table, label_session
from stillmap.places.store import STATE, read_beam_cells
from stillmap.results.labels import read_array
from stillmap.results.pose_graph_g2o import write_g2o
from stillmap.results.reader import SESSIONS
from stillmap.slam import PoseGraph
from stillmap.slam.pose_graph import Constraint

Float = NDArray[np.float64]

CHANGES, CELLS, STATES = "changes.json", "changes.npz", "states.npz"
_TIES = ("first", "first_node", "second", "second_node")


@dataclass(frozen=True, eq=False)
class PlaceResult(ShortRepr):
    """A merged place, ready to be written.

    Attributes:
        place: its sessions.
        refusals: sessions that are not in it.
        order: names of all inputs, accepted or not, as they were given.
        changes: between sessions, in the order of time.
        shown: state of the cells in D dimensions.
        planar: state of the cells in the plane; in 2D the same.
    """

    place: Place
    refusals: list[Refusal]
    order: list[str]
    changes: list[PlaceChange]
    shown: ShownState
    planar: ShownState

    @property
    def names_in_time(self) -> list[str]:
        """Names of the sessions in the order of time."""
        return [self.place.sessions[k].session.name for k in self.place.in_time()]


def write_sessions(folder: Path, result: PlaceResult) -> None:
    """Write what differs from merge to merge into `sessions/NAME/` of each accepted session."""
    place = result.place
    for time, k in enumerate(place.in_time()):
        one = place.sessions[k]
        home = folder / "sessions" / one.session.name
        poses = place.local_frame.to_map(one.poses)
        write_tum(home / "trajectory.tum", one.session.stamp_ns, poses)
        hit = read_array(home / "beams" / "hit.npy", (None,), "b")
        beams = read_beam_cells(home, len(hit), place.voxel_size)
        centres = beams.place_centres(one.session.node_poses, one.nodes)
        write_npy(
            home / "beams" / "p_static.npy", label_session(result.shown, beams, centres, time)
        )
        _write_state(home / STATE, one)


def _write_state(state: Path, one: PlacedSession) -> None:
    write_npy(state / "nodes.npy", one.nodes)
    write_npy(state / "covariance.npy", one.known_covariance)
    evidence, planar = one.require_evidence()
    if _is_measured_at(state, one):
        return
    write_evidence(state / "evidence.npz", evidence)
    if planar is not evidence:
        write_evidence(state / "planar_evidence.npz", planar)
    if one.measured_at is not None:
        write_npy(state / "measured_at.npy", one.measured_at)


def _is_measured_at(state: Path, one: PlacedSession) -> bool:
    """Whether the evidence in a state, copied from the place that grew, is that of a session."""
    path = state / "measured_at.npy"
    if one.measured_at is None or not path.exists():
        return False
    return np.array_equal(read_array(path, (None, None, None), "f"), one.measured_at)


def write_evidence(path: Path, evidence: Evidence) -> None:
    """Write the blocks of a session's evidence."""
    write_npz(
        path,
        {
            "corner": evidence.corner,
            "hits": evidence.hits,
            "passes": evidence.passes,
            "resolution": np.array(evidence.resolution),
        },
    )


def write_ties(path: Path, ties: Sequence[Tie], dof: int) -> None:
    """Write the constraints between sessions."""
    D = 2 if dof == 3 else 3
    columns = {name: np.array([getattr(tie, name) for tie in ties], np.int64) for name in _TIES}
    write_npz(
        path,
        {
            **columns,
            "T": np.array([tie.T for tie in ties]).reshape(-1, D + 1, D + 1),
            "covariance": np.array([tie.covariance for tie in ties]).reshape(-1, dof, dof),
        },
    )


def write_place_files(folder: Path, result: PlaceResult) -> None:
    """Write the files of the place as a whole, but the map, the report and `run.json`."""
    place = result.place
    homes = [folder / "sessions" / one.session.name for one in place.sessions]
    stamps = np.concatenate([one.session.stamp_ns for one in place.sessions])
    frame = place.local_frame
    poses = frame.to_map(np.concatenate([one.poses for one in place.sessions]))
    with (folder / "trajectory.tum").open("wb") as file:
        for home in homes:
            file.write(read_bytes(home / "trajectory.tum", MAX_BYTES))
    _write_beams(folder / "beams", homes, stamps)
    write_g2o(folder / "graph.g2o", _join_graphs(place), poses)
    write_json(folder / SESSIONS, session_records(result))
    write_json(folder / CHANGES, change_records(result.changes, result.names_in_time, frame))
    write_npz(folder / CELLS, change_cells(result.changes, result.shown.place, frame))
    write_npz(folder / STATES, changed_cell_table(result.planar, result.names_in_time, frame))
    dof = 3 if place.dimension == 2 else 6
    write_ties(folder / TIES, place.ties, dof)


def _write_beams(folder: Path, homes: list[Path], stamps: NDArray[np.int64]) -> None:
    """Write the labels of all sessions one after the other."""
    folder.mkdir()
    write_npy(folder / "stamp_ns.npy", stamps)
    offsets, first = [np.zeros(1, np.int64)], 0
    for home in homes:
        offset = np.asarray(read_array(home / "beams" / "offset.npy", (None,), "i"))
        offsets.append(offset[1:] + first)
        first += int(offset[-1])
    write_npy(folder / "offset.npy", np.concatenate(offsets))
    for name, kind in (("p_static", "f"), ("hit", "b")):
        parts = [read_array(home / "beams" / f"{name}.npy", (None,), kind) for home in homes]
        _write_joined(folder / f"{name}.npy", parts)


def _write_joined(path: Path, parts: list[NDArray[Any]]) -> None:
    """Write arrays one after the other as one, without all of them in memory."""
    from stillmap.core.arrays import iter_bytes

    dtype, length = parts[0].dtype, sum(len(part) for part in parts)
    header = np.lib.format.header_data_from_array_1_0(np.empty(0, dtype))
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {**header, "shape": (length,)})
        for part in parts:
            for block in iter_bytes(part):
                file.write(block)


def _join_graphs(place: Place) -> PoseGraph:
    """The pose graph of all sessions; scans are numbered through all of them."""
    keyframes, constraints, first_scan = [], list[Constraint](), 0
    first_node = np.cumsum([0, *(len(one.nodes) for one in place.sessions)])
    for k, one in enumerate(place.sessions):
        graph, base = one.session.graph, int(first_node[k])
        keyframes.append(graph.keyframes + first_scan)
        constraints += [
            Constraint(base + c.first, base + c.second, c.T, c.covariance)
            for c in graph.constraints
        ]
        first_scan += len(one.session.stamp_ns)
    constraints += [
        Constraint(
            int(first_node[tie.first]) + tie.first_node,
            int(first_node[tie.second]) + tie.second_node,
            tie.T,
            tie.covariance,
        )
        for tie in place.ties
    ]
    nodes = np.concatenate([one.nodes for one in place.sessions])
    return PoseGraph(np.concatenate(keyframes), nodes, constraints)


def session_records(result: PlaceResult) -> list[dict[str, Any]]:
    """The entries of `sessions.json`, in the order in which the inputs were given."""
    placed = {one.session.name: one for one in result.place.sessions}
    refused = {one.name: one for one in result.refusals}
    counts = [len(one.session.stamp_ns) for one in result.place.sessions]
    first_scan = dict(zip(placed, np.cumsum([0, *counts]).tolist(), strict=False))
    return [
        _placed_record(placed[name], first_scan[name], result.place.local_frame)
        if name in placed
        else {
            "name": name,
            "input": refused[name].input,
            "accepted": False,
            "why": refused[name].why,
        }
        for name in result.order
        if name in placed or name in refused
    ]


def _placed_record(one: PlacedSession, first_scan: int, frame: LocalFrame) -> dict[str, Any]:
    """The entry of a session whose scans begin at `first_scan` of those of the place."""
    stamp_ns = one.session.stamp_ns
    return {
        "name": one.session.name,
        "input": one.session.input,
        "accepted": True,
        "T_place_session": one.between_maps(one.T, frame).tolist(),
        "covariance": one.known_covariance.tolist(),
        "overlap": round(one.overlap, 4),
        "first_stamp_ns": int(stamp_ns[0]),
        "last_stamp_ns": int(stamp_ns[-1]),
        "first_scan": first_scan,
        "scans": len(stamp_ns),
    }
