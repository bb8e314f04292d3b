"""The ROS 2 node: scans in, answers out."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan, PointCloud2
from std_srvs.srv import Trigger
from tf2_ros import TransformListener

from stillmap.core import config
from stillmap.core.errors import InputError
from stillmap.core.profiling import Progress, no_progress
from stillmap.live.history import FOLDER
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import Show
from stillmap.live.ros.inputs import Parameters, declare
from stillmap.live.ros.intake import BACKWARDS, NO_MOUNT, NO_ODOMETRY, Arrival, ScanIntake
from stillmap.live.ros.publishers import MapPublisher, Publishers
from stillmap.live.ros.transforms import Transforms
from stillmap.live.update import DOUBTS
from stillmap.pipeline.options import Options

_NAME = "stillmap"
_ODOMETRY_DEPTH = 50
_SPIN = 0.1  # s after which a signal is seen at the latest
_POLL = 0.02  # s after which scans that wait are tried again
_STATUS_PERIOD = 1.0  # s
_LATENCIES = 1000  # scans over which latency is given


class LiveNode:
    """Maps what arrives, and answers.

    Args:
        options: see Options.
        output: result folder.
        overwrite: replace what is there.
        make_mapper: of these options, with what the parameters changed.
        show: called with each scan and its answer.

    Raises:
        InputError: a parameter is wrong.
    """

    def __init__(
        self,
        options: Options,
        output: Path,
        overwrite: bool,
        make_mapper: Callable[[Options], LiveMapper],
        show: Show | None,
    ) -> None:
        self.node = rclpy.create_node(_NAME)
        self._output, self._overwrite, self._show = output, overwrite, show
        self.parameters = self._declare(options)
        resolution = self.parameters.resolution
        if resolution != options.slam.resolution:
            changes = {"resolution": resolution, "voxel_size": resolution}
            options = config.override(options, {"slam": changes}, "parameter")
        self._transforms = Transforms(self.parameters)
        self._intake = ScanIntake(self.parameters, self._transforms)
        self._publishers = Publishers(self.node, self.parameters)
        self._map_publisher = MapPublisher(self.node, self.parameters, options.output.map_mode)
        self._is_simulated = bool(self.node.get_parameter("use_sim_time").value)
        self._options, self._make_mapper = options, make_mapper
        self._former: threading.Thread | None = None  # writes the map before this one
        self._lock, self._save_lock = threading.Lock(), threading.Lock()
        self._latency = deque[float](maxlen=_LATENCIES)
        self._stamp_ns, self.scans, self._map_due, self._is_map_old = 0, 0, 0.0, False
        self._doubts, self._reported = Counter[str](), Counter[str]()
        self._subscribe()
        self._save_node = self._make_save_node()
        self._mapper = make_mapper(options)

    def spin(self, stop: threading.Event) -> None:
        """Answer until `stop`; requests to save in a thread of their own, so that mapping goes on.

        Not by an executor of several threads: that of rclpy hands a callback that waits to its
        threads over and over, and nothing else gets to run meanwhile.
        """

        def spin(node: Any) -> None:
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            while not stop.is_set():
                executor.spin_once(timeout_sec=_SPIN)
            executor.remove_node(node)

        saves = threading.Thread(target=spin, args=(self._save_node,))
        saves.start()
        try:
            spin(self.node)
        finally:
            stop.set()
            saves.join()

    def close(self) -> None:
        """Forget all scans."""
        if self._former is not None:
            self._former.join()
        self._mapper.close()
        self._save_node.destroy_node()
        self.node.destroy_node()

    def save(self, progress: Progress = no_progress) -> None:
        """Write the result folder, as known now. Mapping may go on meanwhile.

        Args:
            progress: shows how far it is written.

        Raises:
            InputError: there is nothing to save yet, or the folder cannot be written to.
        """
        with self._save_lock:
            if not self.scans:
                raise InputError("no scan has been mapped yet")
            with self._lock:
                snapshot = self._mapper.snapshot()
            snapshot.save(self._output, overwrite=self._overwrite, progress=progress)
            self._overwrite = True  # the next one replaces ours

    def _declare(self, options: Options) -> Parameters:
        def declare_one(name: str, default: Any, meaning: str) -> Any:
            about = ParameterDescriptor(description=meaning, dynamic_typing=True, read_only=True)
            return self.node.declare_parameter(name, default, about).value

        return declare(declare_one, resolution=options.slam.resolution)

    def _subscribe(self) -> None:
        node, names = self.node, self.parameters

        def subscribe(kind: Any, topic: str, callback: Any, depth: int) -> None:
            qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)
            node.create_subscription(kind, topic, callback, qos)

        kind = LaserScan if names.dimension == 2 else PointCloud2
        for topic in names.topics:
            subscribe(kind, topic, self._scan_callback(topic), names.scan_queue_size)
        if names.odom_frame:
            subscribe(Odometry, names.odom_topic, self._on_odometry, _ODOMETRY_DEPTH)
        self._listener = _Listener(self._transforms.buffer, node, self._answer_all)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._poll = node.create_timer(_POLL, self._answer_all, clock=steady)
        node.create_timer(_STATUS_PERIOD, self._report, clock=steady)

    def _make_save_node(self) -> Any:
        """A hidden node with the service ~/save_map."""
        # without arguments: a new name or namespace is meant for the other one
        node = rclpy.create_node(
            f"_{_NAME}_save",
            namespace=self.node.get_namespace(),
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        name = f"{self.node.get_fully_qualified_name()}/save_map"
        node.create_service(Trigger, name, self._on_save)
        return node

    def _scan_callback(self, topic: str) -> Any:
        def add(message: Any) -> None:
            self._intake.add_scan(topic, message, time.monotonic())
            if self._intake.set_back and self._is_simulated:
                self._begin_anew()
            self._answer_all()

        return add

    def _on_odometry(self, message: Any) -> None:
        self._transforms.add_odometry(message)
        self._answer_all()

    def _on_save(self, _: Any, response: Any) -> Any:
        try:
            self.save()
        except (InputError, OSError) as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, f"wrote {self._output}"
        log = self.node.get_logger()
        (log.info if response.success else log.error)(response.message)
        return response

    def _answer_all(self) -> None:
        while (arrival := self._intake.take(time.monotonic())) is not None:
            self._answer(arrival)
        if not self._intake.waiting:
            self._poll.cancel()  # a timer that only ticks takes a tenth of a core
        elif self._poll.is_canceled():
            self._poll.reset()
        now = time.monotonic()
        if self._is_map_old and now >= self._map_due:
            self._map_due, self._is_map_old = now + self.parameters.map_update_interval, False
            with self._lock:
                grid = self._mapper.map
            self._map_publisher.publish(grid, self._stamp_ns)

    def _begin_anew(self) -> None:
        """Begin a new map: a simulation or the replay of a bag was started again. The one so far is
        written beside the result, while the new one is made."""
        folder = self._output.with_name(f"{self._output.name}-before")
        self.node.get_logger().warning(
            f"the clock was set back by {self._intake.set_back:.0f} s: a new map begins; "
            f"the one so far goes to {folder}"
        )
        self._intake.begin_anew()
        if self._former is not None:
            self._former.join()
        with self._lock:
            self._mapper.move_folder(folder / FOLDER)
            former, self._mapper = self._mapper, self._make_mapper(self._options)
            self.scans = 0
        self._map_due = 0.0  # updates are of the new map
        self._former = threading.Thread(target=self._save_former, args=(former, folder))
        self._former.start()

    def _save_former(self, mapper: LiveMapper, folder: Path) -> None:
        with self._save_lock:  # a request to save it may not have been done yet
            try:
                mapper.save(folder, overwrite=True)
            except (InputError, OSError) as error:
                self.node.get_logger().error(str(error))
            finally:
                mapper.close()

    def _answer(self, arrival: Arrival) -> None:
        with self._lock:
            update = self._mapper.push(arrival.beams, arrival.T_odom_base)
        self._publishers.publish_answer(arrival, update)
        self._latency.append(time.monotonic() - arrival.arrived)
        self._stamp_ns, self._is_map_old = arrival.beams.stamp_ns, True
        if not self._map_publisher.publish_changes(update.changes, self._stamp_ns):
            self._map_due = time.monotonic()
        self.scans += 1
        self._doubts.update(update.doubts)
        if self._show is not None:
            self._show(self._mapper, arrival.beams, update)
        with self._lock:
            self._mapper.update_map()

    def _report(self) -> None:
        """Diagnostics of the last second; the last map, where scans have stopped."""
        self._answer_all()
        counts = self._intake.counts
        new, doubts = counts - self._reported, self._doubts
        self._reported, self._doubts = Counter(counts), Counter()
        ms = 1e3 * np.array(self._latency or [0.0])
        values = {
            "scans": str(self.scans),
            "latency median (ms)": f"{np.median(ms):.1f}",
            "latency 99 % (ms)": f"{np.quantile(ms, 0.99):.1f}",
            "odometry": self._transforms.source or "none",
            **{reason: str(n) for reason, n in sorted(counts.items())},
            **{DOUBTS[name]: str(n) for name, n in sorted(doubts.items())},
        }
        level, text = DiagnosticStatus.OK, "mapping" if self.scans else "waiting for scans"
        if new or doubts:
            level = DiagnosticStatus.WARN
            text = "; ".join([*new, *(DOUBTS[name] for name in doubts)])
        if new[BACKWARDS] or new[NO_MOUNT]:
            level = DiagnosticStatus.ERROR
        if self._intake.set_back:
            text = f"clock set back by {self._intake.set_back:.0f} s: start the node anew; {text}"
        self._publishers.publish_status(level, text, values)
        self._warn(new)

    def _warn(self, new: Counter[str]) -> None:
        """Say once in the log what keeps scans from being mapped."""
        names, frames = self.parameters, self._transforms.frames
        hints = {
            NO_MOUNT: f"base_frame is '{names.base_frame}'; TF: {frames}",
            NO_ODOMETRY: f"neither TF from '{names.odom_frame}' to '{names.base_frame}' nor "
            f"'{names.odom_topic}'; scans are mapped without",
        }
        for reason in new:
            if self._intake.counts[reason] == new[reason]:  # for the first time
                hint = f" ({hints[reason]})" if reason in hints else ""
                self.node.get_logger().warning(f"{reason}{hint}")


class _Listener(TransformListener):  # type: ignore[misc]
    """A listener of tf2_ros: what comes may be what scans wait for."""

    def __init__(self, buffer: Any, node: Any, answer: Callable[[], None]) -> None:
        self._answer = answer
        super().__init__(buffer, node)

    def callback(self, message: Any) -> None:
        super().callback(message)
        self._answer()
