"""Recognises records of a part that earlier parts of the same run hold already."""

import hashlib
from array import array

import numpy as np
from numpy.typing import NDArray


class RepeatFilter:
    """Remembers the records of all parts so far, eight bytes each."""

    def __init__(self) -> None:
        self._digests = array("Q")
        self._last_ns: int | None = None
        self._earlier: NDArray[np.uint64] = np.zeros(0, np.uint64)
        self._limit_ns: int | None = None

    def begin_part(self) -> None:
        """All records so far belong to earlier parts."""
        self._earlier = np.sort(np.asarray(self._digests, np.uint64))
        self._limit_ns = self._last_ns

    def is_repeated(self, time_ns: int, *content: bytes) -> bool:
        """True if an earlier part has a record with this content; remembers a new one."""
        found = hashlib.blake2b(digest_size=8)
        for part in content:
            found.update(part)
        digest = int.from_bytes(found.digest(), "little")
        # behind the end of the earlier parts nothing can be repeated
        if self._limit_ns is not None and time_ns <= self._limit_ns:
            at = int(np.searchsorted(self._earlier, np.uint64(digest)))
            if at < len(self._earlier) and int(self._earlier[at]) == digest:
                return True
        self._digests.append(digest)
        self._last_ns = time_ns if self._last_ns is None else max(self._last_ns, time_ns)
        return False
