"""Unpacking that stops at a limit: a few bytes may claim to be terabytes."""

import bz2
import sys
from collections.abc import Callable
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]

from stillmap.errors import InputError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

LIMIT = 256 << 20  # bytes of one chunk or message; recorders write chunks of about one megabyte

ZstdError = zstd.ZstdError


def bz2_unpacked(data: bytes) -> bytes:
    """The content of a bz2 stream; see `_bounded` for errors."""
    return _bounded(bz2.BZ2Decompressor().decompress, data)


def lz4_unpacked(data: bytes) -> bytes:
    """The content of a lz4 frame; see `_bounded` for errors."""
    return _bounded(lz4.frame.LZ4FrameDecompressor().decompress, data)


def zstd_unpacked(data: bytes) -> bytes:
    """The content of a zstd frame; see `_bounded` for errors."""
    return _bounded(zstd.ZstdDecompressor().decompress, data)


def zstd_stream(packed: IO[bytes]) -> Any:
    """The content of a file of zstd frames, to be read piece by piece; a context manager."""
    return zstd.open(packed, "rb")


def _bounded(decompress: Callable[..., Any], data: bytes) -> bytes:
    """What `decompress` gives, up to `LIMIT` bytes.

    Raises:
        InputError: there is more.
        Exception: whatever the library says of damaged data.
    """
    out = bytes(decompress(data, LIMIT + 1))
    if len(out) > LIMIT:
        raise InputError(
            f"a packed part is larger than {LIMIT >> 20} MiB",
            hint="a recording packed in smaller chunks can be read",
        )
    return out
