"""The user's own ROS 2, and a node in it from its start to its end."""

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from stillmap.core.errors import InputError
from stillmap.core.profiling import Progress
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import Show, signal_flag
from stillmap.live.ros.node import LiveNode
from stillmap.pipeline.options import Options

_SPIN = 0.1  # s after which a signal is seen at the latest
_NEEDED = (
    *("rclpy", "tf2_ros", "sensor_msgs", "nav_msgs", "geometry_msgs", "std_srvs"),
    *("visualization_msgs", "diagnostic_msgs"),
)
_HINT = (
    "call `source /opt/ros/DISTRO/setup.bash` first, with the Python that this ROS was built for, "
    "or install stillmap into an environment that has rclpy"
)


class Ros:
    """rclpy, tf2_ros and the message packages, imported when a node is made.

    Attributes:
        rclpy: the module.
        tf2_ros: the module.

    Raises:
        InputError: a package that is needed cannot be imported.
    """

    def __init__(self) -> None:
        for package in _NEEDED:
            _import(package)
        self.rclpy: Any = _import("rclpy")
        self.tf2_ros: Any = _import("tf2_ros")

    def message(self, name: str) -> Any:
        """A class by its name, as `sensor_msgs/msg/LaserScan`; None: its package is missing."""
        package, kind, type_name = name.split("/")
        try:
            return getattr(import_module(f"{package}.{kind}"), type_name)
        except ImportError:
            return None

    def geometry(self, name: str) -> Any:
        """A class of geometry_msgs."""
        return self.message(f"geometry_msgs/msg/{name}")

    def module(self, name: str) -> Any:
        """A module of rclpy, as `qos`."""
        return import_module(f"rclpy.{name}")


def _import(name: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError as error:  # it may be made for another Python
        is_missing = isinstance(error, ModuleNotFoundError) and error.name == name
        what = "is not in this environment" if is_missing else f"cannot be imported: {error}"
        raise InputError(f"{name} {what}", hint=_HINT) from error


def run(
    options: Options,
    output: Path,
    ros_arguments: Sequence[str],
    *,
    overwrite: bool,
    make_mapper: Callable[[Options], LiveMapper],
    show_progress: Callable[[], AbstractContextManager[Progress]],
    show: Show | None = None,
) -> int:
    """Map until Ctrl-C or SIGTERM, then save; returns the number of scans.

    Args:
        options: see Options.
        output: result folder.
        ros_arguments: as ROS reads them.
        overwrite: replace what is there.
        make_mapper: see LiveNode.
        show_progress: shows how far the result is written.
        show: see LiveNode.

    Raises:
        InputError: ROS is not there, a parameter is wrong, or the result cannot be written.
        KeyboardInterrupt: Ctrl-C again while the result is written.
    """
    ros = Ros()
    no_handlers = ros.module("signals").SignalHandlerOptions.NO
    try:
        ros.rclpy.init(args=list(ros_arguments), signal_handler_options=no_handlers)
    except RuntimeError as error:
        raise InputError(f"arguments of ROS: {error}") from error
    live = None
    try:
        live = LiveNode(
            ros, options, output, overwrite=overwrite, make_mapper=make_mapper, show=show
        )
        with signal_flag() as stop:
            try:
                _spin(ros, live, stop)
            finally:  # whatever ended it: nobody drives the same way again
                if live.scans:
                    with show_progress() as progress:
                        live.save(progress)
        return live.scans
    finally:
        if live is not None:
            live.close()
        ros.rclpy.try_shutdown()


def _spin(ros: Ros, live: LiveNode, stop: threading.Event) -> None:
    """Answer until `stop`; requests to save in a thread of their own, so that mapping goes on.

    Not by an executor of several threads: that of rclpy hands a callback that waits to its threads
    over and over, and nothing else gets to run meanwhile.
    """

    def spin(node: Any) -> None:
        executor = ros.module("executors").SingleThreadedExecutor()
        executor.add_node(node)
        while not stop.is_set():
            executor.spin_once(timeout_sec=_SPIN)
        executor.remove_node(node)

    saves = threading.Thread(target=spin, args=(live.save_node,))
    saves.start()
    try:
        spin(live.node)
    finally:
        stop.set()
        saves.join()
