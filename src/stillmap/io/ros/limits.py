"""Unpacking that stops at a limit: a few bytes may claim to be terabytes."""

import bz2
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]

from stillmap.core.errors import InputError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_CHUNK = 256 << 20  # bytes of one chunk or message; recorders write chunks of about one megabyte

ZstdError = zstd.ZstdError

_MAX_GROWTH, _SURELY_FINE = 300, 512 << 20  # of a bag: times its size, bytes
RECORD = 64  # bytes that a record counts for, though nothing be in it


class OutputLimitError(InputError):
    """More comes out of a file than can have been put in."""


class _Left:
    """How many bytes may still come out."""

    def __init__(self, count: int) -> None:
        self.count = count


_left: ContextVar[_Left | None] = ContextVar("left", default=None)


@contextmanager
def limit_output(size: int) -> Iterator[None]:
    """While this lasts, a bag of `size` bytes gives no more than a bag of that size can hold.

    Its index may name one message a million times, and parts that are small each may be many.
    """
    token = _left.set(_Left(max(_MAX_GROWTH * size, _SURELY_FINE)))
    try:
        yield
    finally:
        _left.reset(token)


def count_output(count: int) -> None:
    """Says that so many bytes came out.

    Raises:
        TooMuchError: that is more than there can be.
    """
    left = _left.get()
    if left is None:
        return
    left.count -= count
    if left.count < 0:
        raise OutputLimitError(
            f"is damaged: more than {_MAX_GROWTH} times its size comes out of it"
        )


def decompress_bz2(data: bytes) -> bytes:
    """The content of a bz2 stream; see `_bounded` for errors."""
    return _bounded(bz2.BZ2Decompressor().decompress, data)


def decompress_lz4(data: bytes) -> bytes:
    """The content of a lz4 frame; see `_bounded` for errors."""
    return _bounded(lz4.frame.LZ4FrameDecompressor().decompress, data)


def decompress_zstd(data: bytes) -> bytes:
    """The content of a zstd frame; see `_bounded` for errors."""
    return _bounded(zstd.ZstdDecompressor().decompress, data)


def open_zstd(packed: IO[bytes]) -> Any:
    """The content of a file of zstd frames, to be read piece by piece; a context manager."""
    return zstd.open(packed, "rb")


def _bounded(decompress: Callable[..., Any], data: bytes) -> bytes:
    """What `decompress` gives, up to `LIMIT` bytes.

    Raises:
        InputError: there is more.
        Exception: whatever the library says of damaged data.
    """
    count_output(0)
    out = bytes(decompress(data, MAX_CHUNK + 1))
    count_output(len(out))
    if len(out) > MAX_CHUNK:
        raise InputError(
            f"a packed part is larger than {MAX_CHUNK >> 20} MiB",
            hint="a recording packed in smaller chunks can be read",
        )
    return out
