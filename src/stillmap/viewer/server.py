"""A server of viser's that only this machine reaches, and whose page reaches nothing else.

Who may look, and what the page may reach: this machine, and nothing else.

A port on loopback can be reached by every page in every browser of the machine. A page from
elsewhere says so in `Origin`, and one whose name was turned to 127.0.0.1 says it in `Host`.

What is changed of viser's page before it is sent.
"""

import gzip
import logging
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import rich
import viser
import websockets.asyncio.server

from stillmap.core.errors import InputError

HOST = "127.0.0.1"

# any port: a tunnel may end in another one
_OWN = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")


def is_local_request(headers: Mapping[str, str]) -> bool:
    """Whether a request was meant for this machine, and comes from this page or from none."""
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if not _OWN.fullmatch(host):
        return False
    return origin is None or origin == f"http://{host}"


def content_security_policy(host: str) -> str:
    """The `Content-Security-Policy` of the page at `host`, one of ours: a browser lets it reach
    nothing but where it came from."""
    own = "'self' data: blob:"
    return "; ".join(
        (
            f"default-src {own} 'unsafe-inline'",
            # its kernels are WebAssembly, and all its parts lie in one page
            f"script-src {own} 'unsafe-inline' 'unsafe-eval'",
            f"connect-src {own} ws://{host}",
            "frame-ancestors 'none'",
            "form-action 'none'",
            "base-uri 'none'",
        )
    )


_HEAD = b"<head>"

# viser gives no choice: what its meshes are drawn with goes through a film's curve (ACES), which
# darkens and greys what was photographed. three.js asks for it by a word in each shader.
_AS_THEY_ARE = b"""<script>{
  const drawing = WebGL2RenderingContext.prototype, plain = drawing.shaderSource;
  drawing.shaderSource = function (shader, text) {
    plain.call(this, shader, text.replace("#define TONE_MAPPING", ""));
  };
}</script>"""


def disable_tone_mapping(response: Any) -> None:
    """Let a page of viser's show colours as they were sent; anything else is left as it is.

    Args:
        response: of `websockets`, with `headers` and `body`; both are changed.
    """
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    packed = response.headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(response.body) if packed else response.body
    body = body.replace(_HEAD, _HEAD + _AS_THEY_ARE, 1)
    response.body = gzip.compress(body, 6) if packed else body
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


_OWN_PORT = "_VISER_PORT_OVERRIDE"  # a variable that would tell viser another port


class Server(viser.ViserServer):
    """Without the address for others that viser's own has: it would ask for one far away."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        del verbose
        return None


def start_server(port: int, label: str) -> Server:
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
            server = Server(HOST, port, label=label, verbose=False)
    finally:
        console.quiet = quiet
        if told is not None:
            os.environ[_OWN_PORT] = told
    if not asked:
        stop_server(server)
        raise RuntimeError("this version of viser does not start its server as we know it")
    if port not in (0, server.get_port()):  # viser took the next one
        stop_server(server)
        raise InputError(f"--port {port} is taken", hint="without --port any free one is used")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def stop_server(server: Server) -> None:
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
            if not is_local_request(request.headers):
                return connection.respond(HTTPStatus.FORBIDDEN, "not from this page\n")
            response = process_request(connection, request)
            if response is not None:
                disable_tone_mapping(response)
                response.headers["Content-Security-Policy"] = content_security_policy(
                    request.headers["Host"]
                )
            return response

        return plain(handler, host, port, process_request=answer, **more)

    module.serve = serve  # type: ignore[assignment, misc]
    try:
        yield asked
    finally:
        module.serve = plain  # type: ignore[misc]
