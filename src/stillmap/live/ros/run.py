"""A node in the user's own ROS 2, from its start to its end."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from stillmap.core.errors import InputError
from stillmap.core.profiling import Progress
from stillmap.live.mapper import LiveMapper
from stillmap.live.replay import Show, signal_flag
from stillmap.pipeline.options import Options

_HINT = (
    "call `source /opt/ros/DISTRO/setup.bash` first, with the Python that this ROS was built for, "
    "or install stillmap into an environment that has rclpy"
)


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
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        from stillmap.live.ros.node import LiveNode
    except ImportError as error:  # a package that is missing, or made for another Python
        raise InputError(f"ROS 2 cannot be imported: {error}", hint=_HINT) from error
    try:
        rclpy.init(args=list(ros_arguments), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise InputError(f"arguments of ROS: {error}") from error
    live = None
    try:
        live = LiveNode(options, output, overwrite, make_mapper, show)
        with signal_flag() as stop:
            try:
                live.spin(stop)
            finally:  # whatever ended it: nobody drives the same way again
                if live.scans:
                    with show_progress() as progress:
                        live.save(progress)
        return live.scans
    finally:
        if live is not None:
            live.close()
        rclpy.try_shutdown()
