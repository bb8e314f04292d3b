"""A server of viser's that only this machine reaches, and whose page reaches nothing else."""

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import rich
import viser
import websockets.asyncio.server

from stillmap.errors import InputError
from stillmap.viewer import guard, page

_OWN_PORT = "_VISER_PORT_OVERRIDE"  # a variable that would tell viser another port


class Server(viser.ViserServer):
    """Without the address for others that viser's own has: it would ask for one far away."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        del verbose
        return None


def started(port: int, label: str) -> Server:
    """A server at a port of 127.0.0.1; 0: any that is free.

    Raises:
        InputError: the port is taken.
    """
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True  # viser prints where it is
    # it tells of every request that makes no sense, with a trace
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    told = os.environ.pop(_OWN_PORT, None)
    try:
        with _guarded() as asked:
            server = Server(guard.HERE, port, label=label, verbose=False)
    finally:
        console.quiet = quiet
        if told is not None:
            os.environ[_OWN_PORT] = told
    if not asked:
        stop(server)
        raise RuntimeError("this version of viser does not start its server as we know it")
    if port not in (0, server.get_port()):  # viser took the next one
        stop(server)
        raise InputError(f"--port {port} is taken", hint="without --port any free one is used")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def stop(server: Server) -> None:
    """Close it, its connections and threads."""
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True
    try:
        server.stop()
    finally:
        console.quiet = quiet


@contextmanager
def _guarded() -> Iterator[list[int]]:
    """A server that is started meanwhile answers only what is ours, and says what its page may
    reach; a number per server that was."""
    module, asked = websockets.asyncio.server, list[int]()
    plain = module.serve

    def serve(handler: Any, host: str, port: int, *, process_request: Any, **more: Any) -> Any:
        asked.append(port)

        def answer(connection: Any, request: Any) -> Any:
            if not guard.is_ours(request.headers):
                return connection.respond(HTTPStatus.FORBIDDEN, "not from this page\n")
            response = process_request(connection, request)
            if response is not None:
                page.show_as_they_are(response)
                response.headers["Content-Security-Policy"] = guard.policy(request.headers["Host"])
            return response

        return plain(handler, host, port, process_request=answer, **more)

    module.serve = serve  # type: ignore[assignment, misc]
    try:
        yield asked
    finally:
        module.serve = plain  # type: ignore[misc]
