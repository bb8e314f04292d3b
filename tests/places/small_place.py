"""A small place of four sessions with a change of every kind, as `stillmap merge` writes it."""

import json

import numpy as np

from stillmap.core.arrays import write_npz
from stillmap.io.trajectory import write_tum

NAMES = ("monday", "tuesday", "wednesday", "thursday <b>")
DAY = 86_400 * 10**9
START = 1_780_000_000 * 10**9  # 2026-05-28 20:26:40
CELL = 0.1
ORIGIN = (-4.0, -3.0)
SHAPE = (60, 80)
# column and row from the corner of the map: a chair that comes, a box that leaves, a door
CHAIR, BOX, DOOR, OPEN = (32, 40), (40, 30), (60, 40), (66, 46)
SIZE = 4  # cells along the edge of each


def square(corner):
    """(16, 2) cells in the frame of the map, from a column and row."""
    first = np.array(corner) + np.round(np.array(ORIGIN) / CELL).astype(int)
    steps = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).reshape(-1, 2)
    return first + steps


def box_of(corner):
    """x0, y0, x1, y1 of a square."""
    low = np.array(ORIGIN) + CELL * np.array(corner)
    return [round(float(v), 3) for v in (*low, *(low + CELL * SIZE))]


def occupied_of():
    """(64, 4): the chair from tuesday on, the box until wednesday, the door opens on wednesday."""
    rows = [(0, 1, 1, 1), (1, 1, 1, 0), (1, 1, 0, 0), (0, 0, 1, 1)]
    return np.repeat(np.array(rows, bool), SIZE**2, axis=0)


def make_changes():
    """The entries of `changes.json`."""
    return [
        _change(0, "appeared", CHAIR, 0, 1),
        {**_change(1, "moved", OPEN, 1, 2), "from_box": box_of(DOOR)},
        _change(2, "door", DOOR, 1, 2),
        _change(3, "gone", BOX, 1, 3),
    ]


def _change(number, kind, corner, before, after):
    between = [NAMES[before], NAMES[after]]
    box = box_of(corner)
    return {
        "id": number,
        "kind": kind,
        "box": box,
        "between": between,
        "probability": 0.9 + 0.01 * number,
    }


def make_place(folder, *, names=NAMES, step=DAY):
    """Write a place; returns its folder."""
    folder.mkdir(parents=True)
    sessions, stamps, poses = [], [], []
    for k, name in enumerate(names):
        home = folder / "sessions" / name
        home.mkdir(parents=True)
        stamp_ns = START + k * step + 10**9 * np.arange(5)
        T = np.tile(np.eye(3), (5, 1, 1))
        T[:, 0, 2], T[:, 1, 2] = np.linspace(-2, 2, 5), 0.2 * k
        write_tum(home / "trajectory.tum", stamp_ns, T)
        stamps.append(stamp_ns)
        poses.append(T)
        sessions.append(_session(name, stamp_ns, 0.1 * k, 5 * k))
    sessions.insert(
        1,
        {"name": "lost", "input": "/logs/lost.bag", "accepted": False, "why": "no <i>overlap</i>"},
    )
    (folder / "sessions.json").write_text(json.dumps(sessions))
    (folder / "changes.json").write_text(json.dumps(make_changes()))
    write_tum(folder / "trajectory.tum", np.concatenate(stamps), np.concatenate(poses))
    write_states(folder, names)
    _write_map(folder)
    _write_objects(folder, names)
    (folder / "run.json").write_text(json.dumps(RECORD))
    (folder / "report.html").write_text("<!doctype html>")
    return folder


RECORD = {
    "format_version": 1,
    "dimension": 2,
    "input": {"format": "stillmap place", "path": None},
    "options": {},
    "counts": {"scans": 20, "beams": 2000, "hits": 1800, "dynamic": 90},
    "area": {"known": 24.0},
    "quality": {"overall": 81.7, "labels": None, "geometry": 81.7},
    "place": {"map_state": "last", "constraints": 17, "resolution": CELL, "voxel_size": CELL},
}


def _session(name, stamp_ns, yaw, first):
    c, s = float(np.cos(yaw)), float(np.sin(yaw))
    return {
        "name": name,
        "input": f"/logs/{name}.bag",
        "accepted": True,
        "T_place_session": [[c, -s, 1.5], [s, c, -2.25], [0.0, 0.0, 1.0]],
        "covariance": np.zeros((3, 3)).tolist(),
        "overlap": 0.75,
        "first_stamp_ns": int(stamp_ns[0]),
        "last_stamp_ns": int(stamp_ns[-1]),
        "first_scan": first,
        "scans": len(stamp_ns),
    }


def write_states(folder, names=NAMES, **other):
    """Write `states.npz`, of the first sessions where there are fewer names than four."""
    occupied = np.tile(occupied_of(), (1, -(-len(names) // 4)))[:, : len(names)]
    observed = np.ones_like(occupied)
    observed[2 * SIZE**2 - 8 : 2 * SIZE**2, 2:3] = False  # half of the box on wednesday
    arrays = {
        "cells": np.concatenate([square(one) for one in (CHAIR, BOX, DOOR, OPEN)]).astype(np.int32),
        "occupied": occupied,
        "observed": observed,
        "shown": occupied[:, -1],
        "resolution": np.array(CELL),
        "sessions": np.array(names, np.str_),
    }
    write_npz(folder / "states.npz", {**arrays, **other})


def _write_map(folder):
    p_occupied = np.full(SHAPE, np.nan, np.float32)
    p_occupied[5:55, 5:75] = 0.0
    p_occupied[5, 5:75] = p_occupied[54, 5:75] = 1.0
    for column, row in (CHAIR, OPEN):  # what stands there in the last session
        p_occupied[row : row + SIZE, column : column + SIZE] = 1.0
    parts = {"p_occupied": p_occupied, "origin": np.array([*ORIGIN, 0.0]), "resolution": CELL}
    write_npz(folder / "map.npz", {name: np.asarray(part) for name, part in parts.items()})


def _write_objects(folder, names):
    (folder / "objects").mkdir()
    objects = []
    for k, name in enumerate(names[:2]):  # at the same time of each session's own clock
        stamp_ns = (START + k * DAY + 10**9 * np.arange(1, 4)).tolist()
        track = {"stamp_ns": stamp_ns, "x": [0, 1, 2], "y": [k, k, k], "vx": [1] * 3, "vy": [0] * 3}
        objects.append({"id": k, "size": [0.5, 0.4], "track": track, "session": name})
    (folder / "objects/objects.json").write_text(json.dumps(objects))
