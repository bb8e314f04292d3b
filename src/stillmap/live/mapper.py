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
from stillmap.core.parallel import resolve_threads
from stillmap.core.profiling import Progress, no_progress
from stillmap.em import CellProbabilities
from stillmap.io.array_checks import poses_to_matrices
from stillmap.live.causal_labels import CausalLabels, MapChange
from stillmap.live.front_end import FrontEnd, Registration
from stillmap.live.history import History
from stillmap.live.known_map import KnownMap
from stillmap.live.local_map import thin_scan
from stillmap.live.loop_closer import LoopCloser
from stillmap.live.loop_process import LoopProcess, make_closer
from stillmap.live.map_correction import LabelledScan, MapCorrection
from stillmap.live.map_view import project_obstacles
from stillmap.live.movers import MoverTracker
from stillmap.live.observation import BeamSelector, Observation, find_margins
from stillmap.live.place import Mode, NoLoops, PlaceTracker
from stillmap.live.saving import Snapshot
from stillmap.live.scan import Scan, ScanBeams, deskew, to_beams
from stillmap.live.scan_hits import normals_of, thin
from stillmap.live.scan_odometry import ScanOdometry
from stillmap.live.sweep_loop_closer import LiveSweepLoopCloser
from stillmap.live.sweep_odometry import SweepOdometry
from stillmap.live.update import Update
from stillmap.pipeline.options import Options, resolve_resolution
from stillmap.pipeline.result import map_recording
from stillmap.results.build import to_options
from stillmap.results.result import BuiltResult
from stillmap.slam import local_map
from stillmap.slam.scan_hits import Scan as PlanarHits
from stillmap.tracking import MovingObject

Float = NDArray[np.float64]

_MAX_KEPT_BEAMS = {
    2: 400,
    3: 20_000,
}  # of a spaced scan, for loops and for the local map after them
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
        self._place = None if place is None else PlaceTracker(KnownMap(place), mode)
        self._in_background = background
        self._scratch = None if scratch is None else Path(scratch)
        self._T_odom_base: Float | None = None
        self._path_begin = 0  # the first spaced scan in the frame of the map
        self._last_ns: int | None = None
        self._changes_due_ns = 0
        self._begin(2)

    def _begin(self, dimension: int) -> None:
        """Be ready for the first scan."""
        D, options = dimension, self.options
        slam = resolve_resolution(options, D).slam
        self._dimension, self._slam = D, slam
        self._odometry: FrontEnd = (
            ScanOdometry(slam) if D == 2 else SweepOdometry(slam, resolve_threads(options.threads))
        )
        self._labels = CausalLabels(D, slam.resolution, options.em)
        self._selector = BeamSelector(options.em.time_bin)
        self._movers = MoverTracker(D)
        self._history = History(D, self._scratch)
        self._closer: LoopClosing | None = None
        self._T_map_local, self._drift = np.eye(D + 1), np.zeros((3, 3))
        # of the spaced scans: in the frame of the odometry by scans; in the map, where corrected
        self._spaced, self._corrected = list[Float](), np.zeros((0, D + 1, D + 1))
        self._correction: MapCorrection | None = None

    def push(self, scan: Scan | ScanBeams, odometry: ArrayLike | None = None) -> Update:
        """Register a scan, label its beams, and add it to the map.

        Args:
            scan: the next scan in time; the first one says whether mapping is in 2D or 3D.
            odometry: T_odom_base at its stamp, (3,) x, y, theta, or (3, 3), in 3D (4, 4); None:
                there is none.

        Raises:
            ValueError: names the argument, what was expected, and what it was.
            OSError: the disk of `scratch` is full.
        """
        beams = scan if isinstance(scan, ScanBeams) else to_beams(scan)
        self._require_next(beams)
        T_odom_base = self._to_matrix(odometry)
        increment = self._increment(T_odom_base)
        prior = self._odometry.predict(beams, increment)
        hits = self._weigh(self._odometry.select(beams, prior), prior)
        found = self._odometry.register(beams, hits, prior, increment)  # M-step: (9)
        if found.is_carried:
            self._movers.clear()
        if found.is_carried and self._place is not None:
            self._place.lose(len(self._history))
            self._labels.clear()
            self._path_begin = len(self._spaced)
        pose, anchor = self._T_map_local @ found.T, len(self._spaced) - 1
        deskewed = deskew(beams, found.twist)
        labelled = LabelledScan(self._observe(deskewed, hits, anchor), found.T)
        self._labels.add(labelled.observation, pose)
        p_static = self._labels.label(deskewed, pose)  # E-step: (8)
        self._movers.add(deskewed, found.T, p_static)
        self._history.append(beams, p_static, T_odom_base, pose, found.T, anchor)
        self._T_odom_base, self._last_ns = T_odom_base, beams.stamp_ns
        update = self._to_update(beams.stamp_ns, found, p_static, T_odom_base)
        is_spaced = self._add_to_maps(deskewed, labelled, np.nan_to_num(p_static), found)
        if is_spaced and self._place is not None and self._place.is_lost:
            return self._localize(self._place, thin(hits), update, T_odom_base)
        return update

    def _observe(self, beams: ScanBeams, hits: Any, anchor: int) -> Observation:
        """What a scan adds to the labels."""
        margin = None
        if isinstance(hits, PlanarHits):
            margin = find_margins(beams, normals_of(beams, hits), self._selector.select(beams))
        return Observation(beams, margin, max(anchor, 0))

    def _localize(
        self, place: PlaceTracker, hits: PlanarHits, update: Update, T_odom_base: Float | None
    ) -> Update:
        """Search the robot in the known map; the update with its pose there, if it is found."""
        T = place.localize(self._labels, hits, update.pose, len(self._history) - 1)
        if T is None:
            return update
        self._odometry.enter(place.make_local_map(), T)
        place.enter(self._labels, T)
        self._movers.move(T)
        self._path_begin = len(self._spaced)
        pose = T @ update.pose
        T_map_odom = None if T_odom_base is None else pose @ se2.inverse(T_odom_base)
        doubts = tuple(doubt for doubt in update.doubts if doubt not in ("lost", "ambiguous"))
        movers = self._movers.movers(self._T_map_local)
        return dataclasses.replace(
            update, pose=pose, T_map_odom=T_map_odom, doubts=doubts, movers=movers
        )

    def label(self, scan: Scan | ScanBeams, number: int) -> NDArray[np.float32]:
        """(N,) P(static) of the beams of an earlier scan, by what is known now.

        Args:
            scan: as it was pushed.
            number: how many scans were pushed before it.
        """
        beams = scan if isinstance(scan, ScanBeams) else to_beams(scan)
        anchor, local = self._history.at(number)
        beams = deskew(beams, self._history.twist_at(number))
        pose = self._T_map_local @ local
        if 0 <= anchor < len(self._corrected):
            moved = self._corrected[anchor] @ se2.inverse(self._spaced[anchor])
            pose = moved @ local
        return self._labels.label(beams, pose)

    @property
    def poses(self) -> Float:
        """(T, D+1, D+1) T_map_base of all scans, as they are known now."""
        answers = self._history.answers()
        if not len(answers.poses):
            return answers.poses
        if self._place is not None:
            return self._place.to_known(answers.poses)
        # the scan after which each spaced one is the last: itself, but for the first
        scans = np.searchsorted(answers.anchor, np.arange(len(self._spaced)) - 1, side="right") - 1
        every, kept = np.unique(np.maximum(scans, 0), return_index=True)
        corrected, last = self._spaced_poses()[kept], len(answers.local) - 1
        if every[-1] != last:
            every = np.append(every, last)
            corrected = np.concatenate([corrected, (self._T_map_local @ answers.local[-1])[None]])
        return local_map.propagate_corrections(answers.local, every, corrected)

    @property
    def path(self) -> Float:
        """(S, D+1, D+1) T_map_base of spaced scans, as they are known now: quicker than `poses`.
        In a known map only those since the robot was found or lost."""
        return self._spaced_poses()[self._path_begin :]

    @property
    def map(self) -> GridMap:
        """The map of what stands, as it is known now; in 3D of the obstacles above the ground.
        NaN: unknown."""
        if self._dimension == 2:
            return self._labels.to_map()
        output, positions = self.options.output, self.path[:, :3, 3]
        band = output.min_obstacle_height, output.max_obstacle_height
        known, cell = self._labels.known_cells(), self._slam.resolution
        return project_obstacles(known, positions, band, cell)

    @property
    def cells(self) -> CellProbabilities:
        """P(static and occupied) of the cells, in 3D voxels, in which beams ended."""
        return self._labels.known_cells()

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
        return Snapshot(recording, self.poses, answers, self.options, self._scratch)

    def finish(self, progress: Progress = no_progress) -> BuiltResult:
        """The result of `stillmap.build` on all scans: poses, labels and map refined."""
        found = map_recording(
            self._history.recording(), self.options, progress=progress, scratch=self._scratch
        )
        return BuiltResult(**vars(found))

    def close(self) -> None:
        """Forget all scans, and end the process that closes loops, if there is one."""
        if self._closer is not None:
            self._closer.stop()
        self._history.close()

    def __enter__(self) -> LiveMapper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_next(self, beams: ScanBeams) -> None:
        """Check a scan against those before; the first one begins mapping in its dimension."""
        D, is_first = beams.dimension, self._last_ns is None
        if self._place is not None and D == 3:
            raise ValueError("scan: expected a planar one: localization is planar")
        if is_first and self._dimension != D:
            self._begin(D)
        if self._dimension != D:
            raise ValueError(f"scan: expected {self._dimension}D as before, got {D}D")
        if self._last_ns is not None and beams.stamp_ns < self._last_ns:
            late = 1e-9 * (self._last_ns - beams.stamp_ns)
            raise ValueError(f"stamp: expected none before the last scan, got {late:.6f} s earlier")
        if self._closer is None:
            self._closer = self._make_closer()

    def _make_closer(self) -> LoopClosing:
        if self._place is not None or not self._slam.loop_closure:
            return NoLoops()
        if self._in_background:
            return LoopProcess(self._slam, self._dimension, self._scratch)
        threads = resolve_threads(self.options.threads)
        return make_closer(self._slam, self._dimension, self._scratch, threads)

    def _weigh(self, hits: Any, prior: Any) -> Any:
        """The hits with weights P(static): the E-step at the predicted pose."""
        points, T_local_base = self._odometry.end_points(hits, prior)
        weights = self._labels.label_ends(points, self._T_map_local @ T_local_base)
        return dataclasses.replace(hits, weights=weights)

    def _to_matrix(self, odometry: ArrayLike | None) -> Float | None:
        if odometry is None:
            return None
        given = np.asarray(odometry, np.float64)[None]
        out: Float = poses_to_matrices("odometry", given, 1, self._dimension)[0]
        return out

    def _increment(self, T_odom_base: Float | None) -> Float | None:
        if T_odom_base is None or self._T_odom_base is None:
            return None
        out: Float = se2.inverse(self._T_odom_base) @ T_odom_base
        return out

    def _add_to_maps(
        self,
        beams: ScanBeams,
        labelled: LabelledScan,
        e: NDArray[np.float32],
        found: Registration,
    ) -> bool:
        """Add a spaced scan to the local map and to the pose graph, and go on correcting the map;
        True if the scan is spaced."""
        assert self._closer is not None
        self._drift = self._drift + found.drift
        added = self._odometry.add(beams, e)
        if added is not None:
            self._spaced.append(added.T_map_base)
            kept = thin_scan(added, _MAX_KEPT_BEAMS[self._dimension])
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

    def _go_on_correcting(self) -> None:
        """A part of the work on a correction; all of it where nobody waits."""
        if self._correction is None:
            return
        is_done = self._correction.step(self._labels)
        while not (is_done or self._in_background):
            is_done = self._correction.step(self._labels)
        if is_done:
            self._correction.finish(self._labels)
            if self._correction.local_map is not None:
                self._odometry.local_map = self._correction.local_map
            self._T_map_local = self._correction.T_map_local
            self._corrected = self._correction.poses
            self._correction = None

    def _spaced_poses(self) -> Float:
        """(S, D+1, D+1) T_map_base of the spaced scans."""
        since = np.array(self._spaced[len(self._corrected) :])
        since = since.reshape(-1, *self._T_map_local.shape)
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
        doubts = {
            "slip": found.is_slipping,
            "blind": found.is_blind,
            "carried": found.is_carried,
            "lost": self._place is not None and self._place.is_lost,
            "ambiguous": self._place is not None and self._place.is_ambiguous,
        }
        pose = self._T_map_local @ found.T
        return Update(
            pose,
            found.covariance,
            p_static,
            None if T_odom_base is None else pose @ se2.inverse(T_odom_base),
            tuple(name for name, is_so in doubts.items() if is_so),
            self._take_changes(stamp_ns),
            self._movers.movers(self._T_map_local),
        )


LoopClosing = LoopCloser | LiveSweepLoopCloser | LoopProcess | NoLoops
