"""Who may see the page: only who knows its address, which has a secret in its path.

Every user of a machine can reach a port of its loopback interface. The address that a browser is
started with can be read in the list of processes: it works once, and leads to the real one.
"""

import secrets
from hmac import compare_digest

_BYTES = 24  # of a secret


class Access:
    """The secrets of one server, and the paths that they open.

    Attributes:
        token: first segment of the path of every request.
    """

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(_BYTES)
        self._tickets = set[str]()

    def issue_ticket(self) -> str:
        """A first segment that is led to the token, once."""
        ticket = secrets.token_urlsafe(_BYTES)
        self._tickets.add(ticket)
        return ticket

    def redeem(self, path: str) -> bool:
        """True if a path is a ticket that was issued; not a second time."""
        found = [one for one in self._tickets if _is_equal(_split(path)[0], one)]
        self._tickets.difference_update(found)
        return bool(found)

    def strip(self, path: str) -> str | None:
        """The path below the token, from `/` on; empty for the token alone, None without it."""
        head, rest = _split(path)
        return rest if _is_equal(head, self.token) else None


def _split(path: str) -> tuple[str, str]:
    """The first segment of a path, and all that follows."""
    head, slash, rest = path.removeprefix("/").partition("/")
    return head, slash + rest


def _is_equal(given: str, secret: str) -> bool:
    # in a time that does not tell how much of it is right
    return compare_digest(given.encode("utf-8", "surrogateescape"), secret.encode())
