"""Several files, or messages, as the bytes of one input; and how one of them is changed."""

import random
import struct
from collections.abc import Callable

Change = Callable[[bytes], bytes]


def joined(parts: list[bytes]) -> bytes:
    """Each with its length before it."""
    return b"".join(struct.pack("<I", len(part)) + part for part in parts)


def split(data: bytes) -> list[bytes]:
    """What was joined; whatever the bytes are, they are parts of something."""
    parts, at = [], 0
    while at + 4 <= len(data):
        size = struct.unpack_from("<I", data, at)[0]
        parts.append(data[at + 4 : at + 4 + size])
        at += 4 + size
    return parts


def changed(data: bytes, change: Change, chance: random.Random) -> bytes:
    """One part changed; now and then one lost, doubled, or put where another was."""
    parts = split(data)
    if not parts:
        return joined([change(data)])
    at, other = chance.randrange(len(parts)), chance.randrange(len(parts))
    kind = chance.randrange(12)
    if kind == 0:
        parts[at] = b""
    elif kind == 1:
        parts[other] = parts[at]
    elif kind == 2 and len(parts) < 64:
        parts.append(parts[at])
    elif kind == 3 and len(parts) > 1:
        del parts[at]
    else:
        parts[at] = change(parts[at])
    return joined(parts)
