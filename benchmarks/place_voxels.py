"""The truth about sessions in 3D: voxels that what changed was seen in, or is said to be."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from place_cells import MIN_BEAMS, SHORT, Seen
from place_truth import SessionTruth

from stillmap.core.recording import Recording
from stillmap.sim.session_layout import Place
from stillmap.slam import deskew_recording
from stillmap.slam.options import SlamOptions

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

VOXEL = 0.2  # m
_BLOCK = 1 << 18  # beams
_BITS, _HALF = 21, 1 << 20  # of a key per axis: no world is wider than 200 km
_NEIGHBOURS = [step for step in product((-1, 0, 1), repeat=3) if any(step)]


class Voxels:
    """K voxels in the world.

    Attributes:
        key: (K,) rising.
        neighbours: (26, K) indices of the voxels around each; -1: not among these.
    """

    def __init__(self, points: Float) -> None:
        """Those that hold points (N, 3)."""
        self.key = np.unique(_keys(points))
        steps = _pack(np.array(_NEIGHBOURS)) - _pack(np.zeros((1, 3), np.int64))
        self.neighbours = np.array([self._look_up(self.key + step) for step in steps])

    def find(self, points: Float) -> Index:
        """(N,) index of the voxels of points (N, 3), or -1."""
        return self._look_up(_keys(points))

    def centres(self) -> Float:
        """(K, 3) metres."""
        mask = (1 << _BITS) - 1
        cells = np.stack([self.key >> 2 * _BITS, self.key >> _BITS & mask, self.key & mask], axis=1)
        return np.asarray((cells - _HALF + 0.5) * VOXEL, np.float64)

    def widen(self, voxels: Bool) -> Bool:
        """(K,) these voxels and their 26 neighbours."""
        padded = np.append(voxels, False)  # -1 is the last one
        return np.asarray(voxels | padded[self.neighbours].any(axis=0))

    def _look_up(self, keys: NDArray[np.int64]) -> Index:
        if not len(self.key):
            return np.full(len(keys), -1)
        at = np.minimum(np.searchsorted(self.key, keys), len(self.key) - 1)
        return np.where(self.key[at] == keys, at, -1)


def _keys(points: Float) -> NDArray[np.int64]:
    return _pack(np.floor(points / VOXEL).astype(np.int64))


def _pack(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    x, y, z = (cells + _HALF).T
    return np.asarray((((x << _BITS) + y) << _BITS) + z)


@dataclass(frozen=True, eq=False)
class VoxelTruth:
    """The truth about K voxels of S sessions, as `CellTruth` has it about cells.

    Surfaces are what beams at true poses show: a voxel in which at least MIN_BEAMS of them end.

    Attributes:
        voxels: in which a beam ended on something that changed, or that a change names.
        seen: of each session, (K,).
        surfaces: (S, K) whether a surface of what stands there runs through the voxel.
        fixed: (K,) the same of surfaces that are there in all sessions.
        drawn: the surface (K,) of each object that changed, at each of its places.
        recordings: deskewed.
    """

    voxels: Voxels
    seen: tuple[Seen, ...]
    surfaces: Bool
    fixed: Bool
    drawn: dict[tuple[int, Place], Bool]
    recordings: tuple[Recording, ...]

    @property
    def edge(self) -> float:
        """m, of a voxel."""
        return VOXEL

    def centres(self) -> Float:
        """(K, 3) metres."""
        return self.voxels.centres()

    def mark(self, points: Float) -> Bool:
        """(K,) the voxels that hold any of points (N, 3)."""
        out = np.zeros(len(self.fixed), bool)
        at = self.voxels.find(points)
        out[at[at >= 0]] = True
        return out

    def widen(self, cells: Bool) -> Bool:
        """(K,) these voxels and their 26 neighbours."""
        return self.voxels.widen(cells)

    def draw_object(self, truth: SessionTruth, number: int, session: int) -> Bool:
        """(K,) the voxels that an object fills in a session of the truth, without fixed ones."""
        place = truth.objects[number].places[session]
        if place is None or (number, place) not in self.drawn:
            return np.zeros(len(self.voxels.key), bool)
        return self.drawn[number, place] & ~self.fixed


def collect_voxels(truth: SessionTruth, sessions: list[int], called: Float) -> VoxelTruth:
    """Observations of these sessions at true poses.

    Args:
        truth: of 3D sessions.
        sessions: their numbers.
        called: (N, 3) points of the voxels in the world that are said to have changed.

    Raises:
        InputError: a recording or its truth is missing or damaged.
    """
    from stillmap.io.stillmap_folder import read

    recordings, ends, on = [], [], []
    for k in sessions:
        beams, recording = truth.beams(k), read(truth.folder / truth.names[k])
        flat = deskew_recording(recording, beams.T_world_base, SlamOptions())
        changed = truth.changed_beams(k)
        hit = np.flatnonzero(flat.hit & beams.static)
        ends.append(flat.end_points(hit, beams.T_world_base))
        on.append(changed[hit])
        recordings.append(flat)
    moved = [end[own >= 0] for end, own in zip(ends, on, strict=True)]
    voxels = Voxels(np.concatenate([called, *moved]))
    at = [voxels.find(end) for end in ends]
    hits = [_count(of, len(voxels.key)) for of in at]
    passes = [
        _count_passes(recording, truth.beams(k).T_world_base, voxels)
        for recording, k in zip(recordings, sessions, strict=True)
    ]
    seen = tuple(Seen(h, p) for h, p in zip(hits, passes, strict=True))
    bare = [of[own < 0] for of, own in zip(at, on, strict=True)]
    fixed = _count(np.concatenate(bare), len(voxels.key)) >= MIN_BEAMS
    drawn = _draw_objects(truth, sessions, at, on, len(voxels.key))
    surfaces = np.array([fixed] * len(sessions))
    for (number, place), of in drawn.items():
        there = [truth.objects[number].places[k] == place for k in sessions]
        surfaces[there] |= of
    return VoxelTruth(voxels, seen, surfaces, fixed, drawn, tuple(recordings))


def _count(at: Index, n: int) -> NDArray[np.int32]:
    """(n,) how often each index occurs; -1 does not count."""
    return np.bincount(at[at >= 0], minlength=n).astype(np.int32)


def _draw_objects(
    truth: SessionTruth, sessions: list[int], at: list[Index], on: list[NDArray[np.int32]], n: int
) -> dict[tuple[int, Place], Bool]:
    """The voxels that beams of all sessions show of an object, at each of its places."""
    hits: dict[tuple[int, Place], NDArray[np.int32]] = {}
    for k, of, own in zip(sessions, at, on, strict=True):
        for number in np.unique(own[own >= 0]).tolist():
            place = truth.objects[number].places[k]
            if place is not None:
                count = _count(of[own == number], n)
                hits[number, place] = hits.get((number, place), 0) + count
    return {key: count >= MIN_BEAMS for key, count in hits.items()}


def _count_passes(recording: Recording, poses: Float, voxels: Voxels) -> NDArray[np.int32]:
    """(K,) how many beams pass each voxel, by points a voxel apart along them."""
    out = np.zeros(len(voxels.key), np.int64)
    every = np.flatnonzero(recording.hit)
    for first in range(0, len(every), _BLOCK):
        beams = every[first : first + _BLOCK]
        end = recording.end_points(beams, poses)
        start = recording.T_map_sensor(poses)[recording.scans_of(beams), :3, 3]
        length = np.linalg.norm(end - start, axis=1)
        steps = np.floor(length / VOXEL).astype(np.int64) - SHORT
        order = np.argsort(-steps)
        start, end, steps, length = start[order], end[order], steps[order], length[order]
        step = (end - start) / np.maximum(length, 1e-9)[:, None] * VOXEL
        for k in range(int(steps.max(initial=-1)) + 1):
            longer = int(np.searchsorted(-steps, -k, side="right"))
            at = voxels.find(start[:longer] + k * step[:longer])
            out += _count(at, len(out))
    return out.astype(np.int32)
