"""`stillmap.LiveMapper`: scans in, poses, labels and map out, as they are known at the time."""

# signatures name ArrayLike instead of spelling it out
from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core import se2
from stillmap.core.grid_map import GridMap
from stillmap.core.profiling import Progress, no_progress
from stillmap.io.array_checks import poses_to_matrices
from stillmap.live.causal_labels import CausalLabels, MapChange
from stillmap.live.history import History
from stillmap.live.known_map import KnownMap
from stillmap.live.local_map import MappedScan, thin_scan
from stillmap.live.loop_closer import LoopCloser
from stillmap.live.loop_process import LoopProcess
from stillmap.live.map_correction import LabelledScan, MapCorrection
from stillmap.live.place import Mode, NoLoops, PlaceTracker
from stillmap.live.relocalization import Relocalizer
from stillmap.live.saving import Snapshot
from stillmap.live.scan import Scan, ScanBeams, drop_cover, to_beams
from stillmap.live.scan_hits import normals_of, select_hits, thin
from stillmap.live.scan_odometry import Registration, ScanOdometry
from stillmap.live.update import Update
from stillmap.pipeline.options import Options
from stillmap.pipeline.result import map_recording
from stillmap.results.build import to_options
from stillmap.results.result import BuiltResult
from stillmap.slam import local_map
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import Scan as Hits
from stillmap.tracking import MovingObject

Float = NDArray[np.float64]

_MAX_KEPT_BEAMS = 400  # of a spaced scan, for loops and for the local map after them
# weight of a scan in the running share of hits on what moves; share from which people may walk
# along with the robot, and what was only just seen counts little
_MOVING_RATE, _CROWDED = 0.3, 0.15
_CHANGES_EVERY_NS = 10**9  # between two updates that tell what changed in the map


class LiveMapper:
    """Maps scan by scan.

    Args:
        options: `Options`, or the options to change, as of `stillmap.build`.
        place: folder of a result or a place, in whose map the robot is localized; None: the map
            begins empty.
        mode: "localise": that map stays as it is; "extend": what is seen is added to it.
        background: close loops in a process of their own, so that no scan waits for them; else
            between two scans, the same to the bit every time.
        scratch: folder of the files in which all scans are kept for `save` and `finish`; None: the
            system's temporary folder.

    Examples:
        >>> with stillmap.LiveMapper() as mapper:
        >>>     update = mapper.push(stillmap.Scan(stamp, ranges, angles), odometry=(x, y, theta))
        >>>     update.pose, update.p_static
        >>>     mapper.save("out")
    """

    def __init__(
        self,
        options: Options | Mapping[str, Any] | None = None,
        *,
        place: str | os.PathLike[str] | None = None,
        mode: Mode = "localise",
        background: bool = False,
        scratch: str | os.PathLike[str] | None = None,
    ) -> None:
        self.options = to_options(options)
        self._odometry = ScanOdometry(self.options.slam)
        self._labels = CausalLabels(2, self.options.slam.resolution, self.options.em)
        slam = self.options.slam
        self._place = None if place is None else PlaceTracker(KnownMap(place), mode)
        self._closer = _make_closer(slam, background, place is not None)
        self._in_background = background
        self._scratch = None if scratch is None else Path(scratch)
        self._history = History(2, self._scratch)
        self._T_odom_base: Float | None = None
        self._T_map_local, self._drift = np.eye(3), np.zeros((3, 3))
        # of the spaced scans: in the frame of the odometry by scans; in the map, where corrected
        self._spaced, self._corrected = list[Float](), np.zeros((0, 3, 3))
        self._correction: MapCorrection | None = None
        # a robot that was carried while it maps; scans that were found later: first, last + 1, and
        # their motion in the frame of the odometry by scans; the last scan that agreed with the map
        self._moving = 0.0  # share of the hits, as the labels say a second later
        self._carried: Relocalizer | None = None
        self._moves = list[tuple[int, int, Float]]()
        self._last_agreed = -1
        self._last_ns: int | None = None
        self._changes_due_ns = 0

    def push(self, scan: Scan | ScanBeams, odometry: ArrayLike | None = None) -> Update:
        """Register a scan, label its beams, and add it to the map.

        Args:
            scan: the next scan in time.
            odometry: x, y, theta or (3, 3) T_odom_base at its stamp; None: there is none.

        Raises:
            ValueError: names the argument, what was expected, and what it was.
            OSError: the disk of `scratch` is full.
        """
        beams = drop_cover(scan if isinstance(scan, ScanBeams) else to_beams(scan))
        T_odom_base = _to_matrix(odometry)
        self._require_next(beams)
        increment = self._increment(T_odom_base)
        prior = self._odometry.predict(beams, increment)
        hits = select_hits(beams)
        thinned = self._weigh(thin(hits), prior)
        found = self._odometry.register(beams, thinned, prior, increment)  # M-step: (9)
        if found.is_carried:
            self._lose()
        elif not (found.is_contradicted or self._carried):
            self._last_agreed = len(self._history)
        pose, anchor = self._T_map_local @ found.T, len(self._spaced) - 1
        labelled = LabelledScan(beams, found.T, normals_of(beams, hits), max(anchor, 0))
        if not found.is_contradicted:
            self._labels.add(beams, pose, labelled.normals, labelled.tag)
        p_static = self._labels.label(beams, pose)  # E-step: (8)
        self._history.append(beams, p_static, T_odom_base, pose, found.T, anchor)
        self._T_odom_base, self._last_ns = T_odom_base, beams.stamp_ns
        update = self._to_update(beams.stamp_ns, found, p_static, T_odom_base)
        is_spaced = self._add_to_maps(labelled, np.nan_to_num(p_static), found)
        if is_spaced and self._carried is not None:
            return self._relocalize(self._carried, thinned, update, T_odom_base)
        if is_spaced and self._place is not None and self._place.is_lost:
            return self._localize(self._place, thinned, update, T_odom_base)
        return update

    def _lose(self) -> None:
        """The robot was carried: the labels begin anew, until it is found."""
        if self._place is not None:
            self._place.lose(len(self._history))
            self._labels = CausalLabels(2, self.options.slam.resolution, self.options.em)
        elif self._carried is not None:
            self._carried.begin(self._labels)
        else:
            self._go_on_correcting(to_the_end=True)
            left_behind = self._odometry.left_behind
            self._carried = Relocalizer(self._labels, left_behind, self._T_map_local)

    def _relocalize(
        self, carried: Relocalizer, hits: Hits, update: Update, T_odom_base: Float | None
    ) -> Update:
        """Search a robot that was carried in its own map; the update with its pose there."""
        T = carried.localize(self._labels, hits, update.pose)
        if T is None:
            return update
        self._odometry.enter(carried.join(self._labels, self._odometry.local_map, T), T)
        self._moves.append((self._last_agreed + 1, len(self._history), T))
        self._drift, self._carried = self._drift + carried.covariance, None
        motion = self._T_map_local @ T @ se2.inverse(self._T_map_local)
        return _move_update(update, motion, T_odom_base)

    def _localize(
        self, place: PlaceTracker, hits: Hits, update: Update, T_odom_base: Float | None
    ) -> Update:
        """Search the robot in the known map; the update with its pose there, if it is found."""
        T = place.localize(self._labels, hits, update.pose, len(self._history) - 1)
        if T is None:
            return update
        self._odometry.enter(place.make_local_map(), T)
        place.enter(self._labels, T)
        return _move_update(update, T, T_odom_base)

    def label(self, scan: Scan | ScanBeams, number: int) -> NDArray[np.float32]:
        """(N,) P(static) of the beams of an earlier scan, by what is known now.

        Args:
            scan: as it was pushed.
            number: how many scans were pushed before it.
        """
        beams = scan if isinstance(scan, ScanBeams) else to_beams(scan)
        anchor, local = self._history.at(number)
        for first, last, T in self._moves:
            local = T @ local if first <= number < last else local
        pose = self._T_map_local @ local
        if 0 <= anchor < len(self._corrected):
            moved = self._corrected[anchor] @ se2.inverse(self._spaced[anchor])
            pose = moved @ local
        return self._labels.label(beams, pose)

    @property
    def poses(self) -> Float:
        """(T, 3, 3) T_map_base of all scans, as they are known now."""
        answers = self._history.answers()
        if self._place is not None:
            return self._place.to_known(answers.poses)
        local = answers.local
        for first, last, T in self._moves:
            local[first:last] = T @ local[first:last]
        # the scan after which each spaced one is the last: itself, but for the first
        scans = np.searchsorted(answers.anchor, np.arange(len(self._spaced)) - 1, side="right") - 1
        every, kept = np.unique(np.maximum(scans, 0), return_index=True)
        corrected, last = self._spaced_poses()[kept], len(local) - 1
        if every[-1] != last:
            every = np.append(every, last)
            corrected = np.concatenate([corrected, (self._T_map_local @ local[-1])[None]])
        return local_map.propagate_corrections(local, every, corrected)

    @property
    def map(self) -> GridMap:
        """The map of what stands, as it is known now; NaN: unknown."""
        return self._labels.to_map()

    @property
    def objects(self) -> list[MovingObject]:
        """Moving objects, from the labels and poses of all scans so far."""
        return self.snapshot().build().objects

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        progress: Progress = no_progress,
    ) -> None:
        """Write the folder that `stillmap.build(...).save` writes, of what is known now.

        The poses are those known now, labels and map follow from all scans so far. `live/` has what
        was answered at the time.

        Raises:
            InputError: the folder is taken or cannot be written to.
        """
        self.snapshot().save(path, overwrite=overwrite, progress=progress)

    def snapshot(self) -> Snapshot:
        """All scans so far and what is known of them: to save them while more are pushed."""
        recording, answers = self._history.recording(), self._history.answers()
        place, scratch = self._place, self._scratch
        extended = place.known if place is not None and place.extends else None
        return Snapshot(recording, self.poses, answers, self.options, scratch, extended)

    def finish(self, progress: Progress = no_progress) -> BuiltResult:
        """The result of `stillmap.build` on all scans: poses, labels and map refined."""
        found = map_recording(
            self._history.recording(), self.options, progress=progress, scratch=self._scratch
        )
        return BuiltResult(**vars(found))

    def close(self) -> None:
        """Forget all scans, and end the process that closes loops, if there is one."""
        self._closer.stop()
        self._history.close()

    def __enter__(self) -> LiveMapper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_next(self, beams: ScanBeams) -> None:
        if beams.dimension != 2:
            raise ValueError("scan: expected a planar one")
        if self._last_ns is not None and beams.stamp_ns < self._last_ns:
            late = 1e-9 * (self._last_ns - beams.stamp_ns)
            raise ValueError(f"stamp: expected none before the last scan, got {late:.6f} s earlier")

    def _weigh(self, hits: Hits, prior: MotionPrior) -> Hits:
        """The hits with weights P(static): the E-step at the predicted pose."""
        pose = self._T_map_local @ prior.T_map_base
        return dataclasses.replace(hits, weights=self._labels.label_ends(hits.points, pose))

    def _increment(self, T_odom_base: Float | None) -> Float | None:
        if T_odom_base is None or self._T_odom_base is None:
            return None
        out: Float = se2.inverse(self._T_odom_base) @ T_odom_base
        return out

    def _add_to_maps(
        self, labelled: LabelledScan, e: NDArray[np.float32], found: Registration
    ) -> bool:
        """Add a spaced scan to the local map and to the pose graph, and go on correcting the map;
        True if the scan is spaced."""
        self._drift = self._drift + found.drift
        # without odometry nothing else says how the robot moves
        is_doubted = found.has_odometry and self._moving > _CROWDED
        recent = self._labels.doubt(e) if is_doubted else e
        added = self._odometry.add(labelled.beams, e, recent, self._label_again)
        if self._carried is not None:
            return added is not None
        if added is not None:
            self._spaced.append(added.T_map_base)
            kept = thin_scan(added, _MAX_KEPT_BEAMS)
            self._closer.add(kept, found.explained, self._drift)
            self._drift = np.zeros((3, 3))
        if self._correction is not None:
            self._correction.note_labelled(labelled)
            if added is not None:
                self._correction.note_added(added)
        elif (correction := self._closer.poll()) is not None:
            spaced, poses = np.array(self._spaced), self._spaced_poses()
            new = MapCorrection(correction, self._labels, spaced, poses)
            self._correction = None if new.is_small else new
        self._go_on_correcting()
        return added is not None

    def _label_again(self, scan: MappedScan) -> NDArray[np.float32]:
        """(N,) P(static) of a scan of the local map by what is known now; 0: unusable."""
        T, hit = self._T_map_local @ scan.T_map_base, scan.beams.hit
        e = np.nan_to_num(self._labels.label(scan.beams, T))
        if hit.any():
            self._moving += _MOVING_RATE * (float((e[hit] < 0.5).mean()) - self._moving)
        return e

    def _go_on_correcting(self, *, to_the_end: bool = False) -> None:
        """A part of the work on a correction; all of it where nobody waits."""
        if self._correction is None:
            return
        is_done = self._correction.step()
        while not is_done and (to_the_end or not self._in_background):
            is_done = self._correction.step()
        if is_done:
            self._correction.finish(self._labels)
            self._odometry.local_map = self._correction.local_map
            self._T_map_local = self._correction.T_map_local
            self._corrected = self._correction.poses
            self._correction = None

    def _spaced_poses(self) -> Float:
        """(S, 3, 3) T_map_base of the spaced scans."""
        since = np.array(self._spaced[len(self._corrected) :]).reshape(-1, 3, 3)
        return np.concatenate([self._corrected, self._T_map_local @ since])

    def _take_changes(self, stamp_ns: int) -> list[MapChange]:
        """The parts of the map that changed, once a second."""
        if stamp_ns < self._changes_due_ns:
            return []
        self._changes_due_ns = stamp_ns + _CHANGES_EVERY_NS
        return self._labels.take_changes()

    def _to_update(
        self,
        stamp_ns: int,
        found: Registration,
        p_static: NDArray[np.float32],
        T_odom_base: Float | None,
    ) -> Update:
        place, carried = self._place, self._carried
        doubts = {
            "slip": found.is_slipping,
            "blind": found.is_blind,
            "carried": found.is_carried,
            "contradicted": found.is_contradicted,
            "lost": carried is not None or (place is not None and place.is_lost),
            "ambiguous": any(one is not None and one.is_ambiguous for one in (carried, place)),
        }
        pose = self._T_map_local @ found.T
        return Update(
            pose,
            found.covariance,
            p_static,
            None if T_odom_base is None else pose @ se2.inverse(T_odom_base),
            tuple(name for name, is_so in doubts.items() if is_so),
            self._take_changes(stamp_ns),
        )


def _move_update(update: Update, T: Float, T_odom_base: Float | None) -> Update:
    """The update of a robot that was found: its frame moved by T (3, 3)."""
    pose = T @ update.pose
    T_map_odom = None if T_odom_base is None else pose @ se2.inverse(T_odom_base)
    doubts = tuple(doubt for doubt in update.doubts if doubt not in ("lost", "ambiguous"))
    return dataclasses.replace(update, pose=pose, T_map_odom=T_map_odom, doubts=doubts)


def _make_closer(
    options: SlamOptions, background: bool, is_known: bool
) -> LoopCloser | LoopProcess | NoLoops:
    if is_known:
        return NoLoops()
    return LoopProcess(options) if background else LoopCloser(options)


def _to_matrix(odometry: ArrayLike | None) -> Float | None:
    if odometry is None:
        return None
    out: Float = poses_to_matrices("odometry", np.asarray(odometry, np.float64)[None], 1, 2)[0]
    return out
