"""Online SLAM: the state of one mapping, and the steps by which it takes a scan."""

import dataclasses
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Float32, Int64
from stillmap.core.grid_map import GridMap
from stillmap.core.local_frame import Fields, Shift, shift, shift_poses
from stillmap.core.parallel import resolve_threads
from stillmap.em import CellProbabilities
from stillmap.live.causal_labels import CausalLabels, MapChange
from stillmap.live.history import History
from stillmap.live.known_map import KeptMap
from stillmap.live.local_map import MappedScan
from stillmap.live.loop_process import LoopProcess, make_closer
from stillmap.live.map_frame import LiveOdometry, LoopClosing, MapFrame
from stillmap.live.movers import Mover, MoverTracker
from stillmap.live.registration import Registration
from stillmap.live.robot_finder import Localizer, RobotFinder
from stillmap.live.scan import BeamSelector, Observation, ScanBeams, deskew, find_margins
from stillmap.live.scan_odometry import ScanOdometry, thin
from stillmap.live.sweep_odometry import SweepOdometry
from stillmap.live.update import LaterLabels, Update
from stillmap.pipeline.map_frame import FIELDS
from stillmap.pipeline.options import Options, resolve_resolution
from stillmap.slam.scan_hits import Scan as PlanarHits

# fields that depend on the frame
_FIELDS: Fields = {
    Update: {"pose": "poses", "T_map_odom": "poses", "changes": "part", "movers": "part"},
    MapChange: {"first_cell": "cells"},
    Mover: {"position": "points"},
    KeptMap: {"grid": "part", "points": "points", "route": "poses"},
    **FIELDS,
}
Told = TypeVar("Told", Update, GridMap, CellProbabilities)

_SEARCH_DISTANCE = 0.5  # m between the sweeps with which a robot is searched in a known map


class OnlineSlam:
    """Poses, labels and map from the scans so far: EM with one M-step and two E-steps a scan.

    Args:
        options: see Options.
        history: in which scans and answers are kept.
        place: localization in a known map; None: the map begins empty.
        in_background: close loops in a process of their own; else between two scans.
        lag: s after which each scan is labelled once more; None: it is not.

    Attributes:
        dimension: 2 or 3.
        resolution: m, edge of a cell.
        odometry: by scans, which registers them against the local map.
        labels: of the cells, in the frame of the map.
        frame: the odometry by scans in the map, and the loops that correct it.
        history: all scans, and what was answered.
    """

    def __init__(
        self,
        options: Options,
        history: History,
        place: Localizer | None = None,
        *,
        in_background: bool = False,
        lag: float | None = None,
    ) -> None:
        D = history.dimension
        slam = resolve_resolution(options, D).slam
        threads = resolve_threads(options.threads)
        self.dimension, self.resolution = D, slam.resolution
        spacing = None if place is None else _SEARCH_DISTANCE
        self.odometry: LiveOdometry = (
            ScanOdometry(slam) if D == 2 else SweepOdometry(slam, threads, spacing)
        )
        self.labels = CausalLabels(D, slam.resolution, options.em, threads)
        self.history = history
        self._selector = BeamSelector(options.em.time_bin)
        self._movers = MoverTracker(D)
        self._place = place
        self._lag_ns = None if lag is None else round(1e9 * lag)
        self._recent = deque[tuple[int, ScanBeams]]()  # scans to be labelled once more
        closer: LoopClosing | None = None
        if place is None and slam.loop_closure and in_background:
            closer = LoopProcess(slam, D, history.scratch)
        elif place is None and slam.loop_closure:
            closer = make_closer(slam, D, history.scratch, threads)
        self.frame = MapFrame(D, self.labels, self.odometry, closer, in_background)
        self._finder = RobotFinder(place, self.labels, self.odometry, self.frame)
        self._work_left: Callable[[], object] | None = None  # by the last scan
        self._T_odom_base: Float | None = None  # of the last scan
        self._path_begin = 0  # the first spaced scan in the frame of the map

    def push(self, beams: ScanBeams, T_odom_base: Float | None) -> Update:
        """Register a scan, label its beams, and add it to the map.

        Args:
            beams: of the next scan in time.
            T_odom_base: (D+1, D+1) odometry at its stamp; None: there is none.
        """
        self.update_map()
        increment = self._increment(T_odom_base)
        prior: Any = self.odometry.predict(beams, increment)
        hits: Any = self.odometry.select(beams, prior)
        hits = self._weigh(hits, prior)  # E-step as predicted
        registered = self.odometry.register(beams, hits, prior, increment)  # M-step: (9)
        self._judge(registered)
        deskewed, anchor = deskew(beams, registered.twist), self.frame.last
        observation = self._observe(deskewed, hits, registered.T)
        pose = self.frame.T_map_local @ registered.T
        if not registered.is_contradicted:
            self.labels.add(observation, pose)
        p_static = self.labels.label(deskewed, pose)  # E-step: (8)
        self._movers.add(deskewed, registered.T, p_static)
        self._T_odom_base = T_odom_base
        update = self._to_update(beams.stamp_ns, registered, p_static)
        answer = shift_poses(pose, self._to_map.metres)
        p_static = p_static.copy()  # the user has the other

        def keep() -> MappedScan | None:
            poses = {"pose": answer, "local": registered.T, "anchor": anchor}
            self.history.append(beams, p_static, T_odom_base, **poses, twist=registered.twist)
            if self._lag_ns is not None:
                self._recent.append((len(self.history) - 1, beams))
            return self._add_to_maps(observation, np.nan_to_num(p_static), registered)

        if not self._finder.is_lost:
            self._work_left = keep
        elif (added := keep()) is not None and self._finder.is_lost:
            scan = thin(hits) if isinstance(hits, PlanarHits) else added
            update = self._find_robot(scan, update)
        return self.in_map_frame(update)

    def update_map(self) -> None:
        """Keep the last scan and add it to the maps, unless that is done: the answer to it does not
        wait for that. Due before anything else here is asked for."""
        work, self._work_left = self._work_left, None
        if work is not None:
            work()

    def label(self, beams: ScanBeams, number: int) -> Float32:
        """(N,) P(static) of the beams of an earlier scan, by what is known now.

        Args:
            beams: as they were pushed.
            number: how many scans were pushed before it.
        """
        answer = self.history.answer(number)
        local = self._finder.move(answer["local"][None], number)[0]
        pose = self.frame.to_map(local, int(answer["anchor"]), number)
        return self.labels.label(deskew(beams, answer["twist"]), pose)

    def placement(self) -> tuple[Float, Int64]:
        """Poses and submaps of the scans that are kept, as they are known now: see `Snapshot`."""
        notes, is_whole = self.history.notes(), self.history.kept == len(self.history)
        poses = self._finder.move(notes["local"])
        if self._place is None:  # in a known map that frame is the map's
            poses = self.frame.to_map_all(poses, notes["anchor"], is_whole)
        submaps = self._finder.submaps(len(poses))
        if self._place is not None:
            placed = shift_poses(poses, self._place.origin)
            poses = np.where((submaps == 0)[:, None, None], placed, poses)
        return poses, submaps

    def keep_map(self) -> KeptMap | None:
        """The part of a known map that an extended one keeps, as of now; None: no such map."""
        if self._place is None:
            return None
        return shift(self._place.keep(self.labels), Shift(self._place.origin), _FIELDS)

    @property
    def _to_map(self) -> Shift:
        """From the frame that all here is in to the map frame: in a known map, once the robot is
        found, that one has its own."""
        known = None if self._finder.is_lost else self._place
        return Shift.of(np.zeros(3) if known is None else known.origin, self.resolution)

    def in_map_frame(self, value: Told) -> Told:
        """An update, map or cells, in the map frame."""
        return shift(value, self._to_map, _FIELDS)

    def path(self) -> Float:
        """(S, D+1, D+1) T_map_base of the spaced scans since the robot was found or lost."""
        return shift_poses(self._path(), self._to_map.metres)

    def _path(self) -> Float:
        return self.frame.spaced_poses()[self._path_begin :]

    def route(self) -> Float:
        """(S, D) positions from where what the map shows was seen, in 3D, in the labels' frame."""
        D = self.dimension
        own = self._path()[:, :D, D]
        return own if self._place is None else np.concatenate([self._place.route, own])

    def close(self) -> None:
        """Forget all scans, and end the process that closes loops, if there is one."""
        self.update_map()
        self.frame.stop()
        self.history.close()

    def _weigh(self, hits: Any, prior: Any) -> Any:
        """The hits with weights P(static): the E-step at the predicted pose."""
        points, T_local_base = self.odometry.end_points(hits, prior)
        weights = self.labels.label_ends(points, self.frame.T_map_local @ T_local_base)
        if self.odometry.crowd.walks_along:
            weights = self.labels.doubt(weights, of_ends=True)
        return dataclasses.replace(hits, weights=weights)

    def _judge(self, registered: Registration) -> None:
        """Note that the robot was carried, or is still where the map says."""
        if registered.is_carried:
            self._movers.clear()
            self._path_begin = self.frame.last + 1
            self._finder.lose(len(self.history))
            self.frame.begin_anew(len(self.history))
        elif not registered.is_contradicted:
            self._finder.agree(len(self.history))

    def _observe(self, beams: ScanBeams, hits: Any, T: Float) -> Observation:
        """The observation by which a scan updates the labels."""
        margin = None
        if isinstance(hits, PlanarHits):
            margin = find_margins(beams, hits, self._selector.select(beams))
        return Observation(beams, T, margin, self.frame.tag)

    def _add_to_maps(
        self, observation: Observation, e: Float32, registered: Registration
    ) -> MappedScan | None:
        """Add a scan to the local map and, if it is spaced, to the pose graph, and go on correcting
        the map; the scan if it is spaced."""
        self.frame.add_drift(registered.drift)
        # without odometry nothing else says how the robot moves
        is_doubted = registered.has_odometry and self.odometry.crowd.is_dense
        recent = self.labels.doubt(e) if is_doubted else e
        added = self.odometry.add(observation.beams, e, recent, self._label_again)
        if not self._finder.is_carried:
            if added is not None:
                self.frame.add(added, registered)
            agrees = None if registered.is_contradicted else observation
            self.frame.correct(agrees, added)
        if self.dimension == 3 and self._finder.tie():
            self._path_begin = 0
        return added

    def _label_again(self, scan: MappedScan) -> Float32:
        """(N,) P(static) of a scan of the local map by what is known now; 0: unusable."""
        T, hit = self.frame.T_map_local @ scan.T_map_base, scan.beams.hit
        e = np.nan_to_num(self.labels.label(scan.beams, T))
        self.odometry.crowd.learn(e[hit])
        return e

    def _find_robot(self, scan: PlanarHits | MappedScan, update: Update) -> Update:
        """Search the robot, which is lost; the update with its pose in the map, if it is found."""
        frame = self.frame
        place = self._finder.find(scan, update.pose, len(self.history))
        if place is None:
            return update
        T, motion = place
        self._path_begin = frame.last + 1 if self._place is not None else 0
        self._movers.move(T)
        T_map_odom = update.T_map_odom
        return dataclasses.replace(
            update,
            pose=motion @ update.pose,
            covariance=se2.rotate_covariance(update.covariance, motion),
            T_map_odom=None if T_map_odom is None else motion @ T_map_odom,
            doubts=tuple(name for name in update.doubts if name not in ("lost", "ambiguous")),
            movers=self._movers.movers(frame.T_map_local),
        )

    def _to_update(self, stamp_ns: int, registered: Registration, p_static: Float32) -> Update:
        doubts = {
            "slip": registered.is_slipping,
            "blind": registered.is_blind,
            "carried": registered.is_carried,
            "contradicted": registered.is_contradicted,
            "lost": self._finder.is_lost,
            "ambiguous": self._finder.is_ambiguous,
        }
        T, T_odom_base = self.frame.T_map_local, self._T_odom_base
        pose, covariance = T @ registered.T, se2.rotate_covariance(registered.covariance, T)
        T_map_odom = None if T_odom_base is None else pose @ se2.inverse(T_odom_base)
        changes, movers = self.labels.take_changes(stamp_ns), self._movers.movers(T)
        hindsight = list(self._label_recent(stamp_ns))
        names = tuple(name for name, is_so in doubts.items() if is_so)
        return Update(pose, covariance, p_static, T_map_odom, names, changes, movers, hindsight)

    def _label_recent(self, stamp_ns: int) -> Iterator[LaterLabels]:
        """Labels of the scans that are old enough now, and have none of later yet."""
        while self._recent and stamp_ns - self._recent[0][1].stamp_ns >= (self._lag_ns or 0):
            number, beams = self._recent.popleft()
            if number < self.history.kept:
                yield LaterLabels(number, self.label(beams, number))

    def _increment(self, T_odom_base: Float | None) -> Float | None:
        """(D+1, D+1) of odometry since the last scan; None: not known."""
        if T_odom_base is None or self._T_odom_base is None:
            return None
        return np.asarray(se2.inverse(self._T_odom_base) @ T_odom_base)
