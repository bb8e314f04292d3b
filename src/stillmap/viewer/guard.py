"""Who may look, and what the page may reach: this machine, and nothing else.

A port on loopback can be reached by every page in every browser of the machine. A page from
elsewhere says so in `Origin`, and one whose name was turned to 127.0.0.1 says it in `Host`.
"""

import re
from collections.abc import Mapping

HERE = "127.0.0.1"
# any port: a tunnel may end in another one
_OWN = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?")


def is_ours(headers: Mapping[str, str]) -> bool:
    """Whether a request was meant for this machine, and comes from this page or from none."""
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if not _OWN.fullmatch(host):
        return False
    return origin is None or origin == f"http://{host}"


def policy(host: str) -> str:
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
