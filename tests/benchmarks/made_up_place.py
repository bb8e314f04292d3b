"""A place as `stillmap merge` would write it, made from the truth of simulated sessions."""

import json

import numpy as np
from place_cells import CELL, collect_cells

from stillmap.core import se2
from stillmap.io.stillmap_folder import read
from stillmap.io.trajectory import write_tum


def write_place(folder, truth, shifts=None, refused=(), made_up=True):
    """Write a perfect place, whose frame is the start of the first accepted session.

    Args:
        folder: of the place.
        truth: of the sessions.
        shifts: by session, a transform of its frame: an error.
        refused: sessions that are not accepted.
        made_up: with its map and changes.
    """
    accepted = [k for k in range(len(truth.names)) if k not in refused]
    T_place_world = np.linalg.inv(truth.T_world_session[accepted[0]])
    folder.mkdir()
    listed = []
    for k, name in enumerate(truth.names):
        one = {"name": name, "input": f"days/{name}", "accepted": k in accepted}
        if k in accepted:
            shift = (shifts or {}).get(k, np.eye(truth.dimension + 1))
            T_place_session = T_place_world @ truth.T_world_session[k] @ shift
            one["T_place_session"] = T_place_session.tolist()
            own = np.linalg.inv(truth.T_world_session[k]) @ truth.beams(k).T_world_base
            (folder / "sessions" / name).mkdir(parents=True)
            stamps = read(truth.folder / name).stamp_ns
            write_tum(folder / "sessions" / name / "trajectory.tum", stamps, T_place_session @ own)
        else:
            one["why"] = "too little in common"
        listed.append(one)
    (folder / "sessions.json").write_text(json.dumps(listed))
    if made_up:
        write_changes(folder, truth, T_place_world)
        write_map(folder, truth, accepted, T_place_world)


def write_changes(folder, truth, T_place_world):
    """The true changes; boxes turn with the frame of the place."""
    changes = []
    for number, change in enumerate(truth.changes):
        one = {"id": number, "kind": change.kind, "probability": 1.0}
        one["between"] = [truth.names[k] for k in change.between]
        one["box"] = turn_box(change.box, T_place_world)
        if change.from_box is not None:
            one["from_box"] = turn_box(change.from_box, T_place_world)
        changes.append(one)
    (folder / "changes.json").write_text(json.dumps(changes))


def turn_box(box, T):
    """The box around a box in another frame."""
    corners = np.array([(box[i], box[j]) for i in (0, 2) for j in (1, 3)])
    moved = corners @ T[:2, :2].T + T[:2, 2]
    return [*moved.min(axis=0).tolist(), *moved.max(axis=0).tolist()]


def write_map(folder, truth, accepted, T_place_world):
    """A map of what stands there in the last session, wherever any session looked.

    Its lattice is that of the world, so its origin is turned.
    """
    cells = collect_cells(truth, accepted)
    seen = np.any([one.seen for one in cells.seen], axis=0)
    p_occupied = np.where(seen, np.where(cells.surfaces[-1], 0.9, 0.1), np.nan)
    low = np.array(cells.lattice.low) * CELL
    origin = se2.parameters(T_place_world @ se2.matrix(*low, 0.0))
    np.savez_compressed(
        folder / "map.npz", p_occupied=p_occupied.astype(np.float32), origin=origin, resolution=CELL
    )
