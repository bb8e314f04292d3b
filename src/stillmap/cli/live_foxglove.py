"""`stillmap live --foxglove`: flags, and the server that shows the mapper at work."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from stillmap.cli.console import say
from stillmap.core.errors import InputError

if TYPE_CHECKING:
    from stillmap.live.mapper import LiveMapper
    from stillmap.live.scan import ScanBeams
    from stillmap.live.update import Update

_LAST_PORT = 65_535


def add_foxglove_flags(p: argparse.ArgumentParser) -> None:
    """Add the flags."""
    p.add_argument(
        "--foxglove",
        action="store_true",
        help="serve map, scans, pose and path to Foxglove or Lichtblick on this machine, over a "
        "WebSocket; needs the extra `live`",
    )
    p.add_argument(
        "--host",
        metavar="ADDRESS",
        help="where --foxglove listens; who reaches it can watch (default: 127.0.0.1)",
    )
    p.add_argument(
        "--port", type=int, metavar="N", help="port of --foxglove; 0: a free one (default: 8765)"
    )


@contextmanager
def serve(
    args: argparse.Namespace,
) -> "Iterator[Callable[[LiveMapper, ScanBeams, Update], None] | None]":
    """A function to call with each scan and its update; None without --foxglove.

    Raises:
        InputError: foxglove-sdk is missing, or the port is taken.
    """
    if not args.foxglove:
        if args.host is not None or args.port is not None:
            raise InputError("--host and --port are for --foxglove")
        yield None
        return
    from stillmap.live.foxglove.server import HOST, PORT, FoxgloveServer

    port = PORT if args.port is None else args.port
    if not 0 <= port <= _LAST_PORT:
        raise InputError(f"--port wants 0 to {_LAST_PORT}, got {port}")
    with FoxgloveServer(args.host or HOST, port) as server:
        say(f"seen live at {server.url}, in Foxglove or Lichtblick")
        yield server.show
