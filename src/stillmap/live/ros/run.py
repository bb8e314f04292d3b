"""A node from its start to its end: Ctrl-C or SIGTERM ends it, and the result is written."""

import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from stillmap.core.errors import InputError
from stillmap.core.profiling import Progress
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import signal_flag
from stillmap.live.ros.installation import Ros
from stillmap.live.ros.node import LiveNode, Show
from stillmap.pipeline.options import Options

_SPIN = 0.1  # s after which a signal is seen at the latest


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
    options_of_signals = ros.module("signals").SignalHandlerOptions
    try:
        ros.rclpy.init(args=list(ros_arguments), signal_handler_options=options_of_signals.NO)
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
                        live.save_last(progress)
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
