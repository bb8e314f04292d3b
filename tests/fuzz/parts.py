"""Several files, or messages, as the bytes of one input, and mutation of one of them."""

import random
import struct
from collections.abc import Callable

Mutation = Callable[[bytes], bytes]


def join_parts(parts: list[bytes]) -> bytes:
    """Each part with its length before it."""
    return b"".join(struct.pack("<I", len(part)) + part for part in parts)


def split_parts(data: bytes) -> list[bytes]:
    """The inverse of `join_parts`; any bytes can be split."""
    parts, at = [], 0
    while at + 4 <= len(data):
        size = struct.unpack_from("<I", data, at)[0]
        parts.append(data[at + 4 : at + 4 + size])
        at += 4 + size
    return parts


def mutate_parts(data: bytes, mutate: Mutation, chance: random.Random) -> bytes:
    """Mutate a part; sometimes empty, copy, append or delete one."""
    parts = split_parts(data)
    if not parts:
        return join_parts([mutate(data)])
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
        parts[at] = mutate(parts[at])
    return join_parts(parts)
