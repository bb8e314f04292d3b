"""A viser server for this machine only, and for those who know the token in its address.

Every page in a browser of the machine, and every user, can reach a port of the loopback interface.
Requests of other pages are recognized by `Origin`, DNS rebinding by `Host`, those of other users by
the lack of the token, the first segment of the path; a content security policy keeps the page
itself from requests to elsewhere.
"""

import gzip
import html
import logging
import re
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from hmac import compare_digest
from http import HTTPStatus
from typing import Any

import rich
import viser
import websockets.asyncio.server

from stillmap.core.errors import InputError

HOST = "127.0.0.1"
_TOKEN_BYTES = 24

# any port: a tunnel may use another one
_LOCAL_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")


def is_local_request(headers: Mapping[str, str]) -> bool:
    """True if a request addresses this machine and comes from its own page or from no page."""
    host, origin = headers.get("Host", ""), headers.get("Origin")
    return bool(_LOCAL_HOST.fullmatch(host)) and origin in (None, f"http://{host}")


# viser uses WebAssembly and inline scripts; the page asks its own server only
_LOCAL = "'self' data: blob:"
_POLICY = (
    f"default-src {_LOCAL} 'unsafe-inline'; script-src {_LOCAL} 'unsafe-inline' 'unsafe-eval'; "
    f"connect-src {_LOCAL} ws://%s; frame-ancestors 'none'; form-action 'none'; base-uri 'none'"
)


# viser applies ACES filmic tone mapping to meshes, which darkens photographs, and has no option for
# it; three.js switches it on by a macro in each shader
_DISABLE_TONE_MAPPING = """
  const drawing = WebGL2RenderingContext.prototype, plain = drawing.shaderSource;
  drawing.shaderSource = function (shader, text) {
    plain.call(this, shader, text.replace("#define TONE_MAPPING", ""));
  };"""

# viser's hotkeys listen at the root element; its camera listens above, turns at the arrow keys, and
# has no option for it. A control that keeps the focus after a click would take the keys: Space
# would press it once more.
_FREE_KEYS = """
  document.documentElement.addEventListener("keydown", event => {
    if (["ArrowLeft", "ArrowRight"].includes(event.code)) event.stopPropagation();
  });
  addEventListener("click", event => {
    const control = document.activeElement;
    if (event.detail && control.matches("button, [type=checkbox], [role=slider]")) control.blur();
  });"""

_SCRIPT = f"<script>{{{_DISABLE_TONE_MAPPING}{_FREE_KEYS}\n}}</script>".encode()
_TITLE = b"<title>Viser</title>"


def adapt_page(response: Any, title: str) -> None:
    """Insert the script and the title into viser's page, in place; other responses stay unchanged.

    Args:
        response: of `websockets`, with `headers` and `body`.
        title: plain text.
    """
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    packed = response.headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(response.body) if packed else response.body
    body = body.replace(b"<head>", b"<head>" + _SCRIPT, 1)
    body = body.replace(_TITLE, f"<title>{html.escape(title)}</title>".encode(), 1)
    response.body = gzip.compress(body, 6) if packed else body
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


class Server(viser.ViserServer):
    """Without sharing of the page through a remote server.

    Attributes:
        token: first segment of the path of every request.
    """

    token: str

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self.get_host()}:{self.get_port()}/{self.token}"

    def request_share_url(self, verbose: bool = True) -> str | None:
        del verbose
        return None


def start_server(port: int, title: str) -> Server:
    """Start a server at a port of 127.0.0.1.

    Args:
        port: 0: any free one.
        title: of the page, plain text.

    Raises:
        InputError: the port is taken.
    """
    # websockets logs malformed requests with a traceback
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    token = secrets.token_urlsafe(_TOKEN_BYTES)
    with _quiet_console(), _guard_servers(title, token) as ports:
        server = Server(HOST, port, label="stillmap", verbose=False)
        server.token = token
    if not ports:
        stop_server(server)
        raise RuntimeError("this version of viser does not use websockets.asyncio.server.serve")
    if port not in (0, server.get_port()):  # viser has taken the next free one
        stop_server(server)
        raise InputError(f"port {port} is taken", hint="port=0 takes any free one")
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def stop_server(server: Server) -> None:
    """Stop a server, its connections and threads."""
    with _quiet_console():
        server.stop()


@contextmanager
def _quiet_console() -> Iterator[None]:
    """Within the context viser prints nothing, as its address."""
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = quiet


@contextmanager
def _guard_servers(title: str, token: str) -> Iterator[list[int]]:
    """Within the context, new servers check requests and send the policy; yields their ports."""
    module, ports = websockets.asyncio.server, list[int]()
    original = module.serve

    def serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        ports.append(port)

        def answer(connection: Any, request: Any) -> Any:
            given, slash, rest = request.path.removeprefix("/").partition("/")
            # in a time that does not show how much of it is right
            known = compare_digest(given.encode("utf-8", "surrogateescape"), token.encode())
            if not known or not is_local_request(request.headers):
                return connection.respond(HTTPStatus.FORBIDDEN, "not the page's own request\n")
            if not slash and "Upgrade" not in request.headers:
                response = connection.respond(HTTPStatus.FOUND, "")
                response.headers["Location"] = f"/{token}/"
                return response
            request.path = f"/{rest}"
            response = process_request(connection, request)
            if response is not None:
                adapt_page(response, title)
                response.headers["Content-Security-Policy"] = _POLICY % request.headers["Host"]
                response.headers["Referrer-Policy"] = "no-referrer"
            return response

        return original(handler, host, port, process_request=answer, **options)

    module.serve = serve  # type: ignore[assignment, misc]
    try:
        yield ports
    finally:
        module.serve = original  # type: ignore[misc]
