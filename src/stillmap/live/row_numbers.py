"""Numbers of the scans that the rows of an array are of, where some scans were dropped."""

from array import array

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.int64]


class RowNumbers:
    """Rising numbers of rows, in runs of successive ones."""

    def __init__(self) -> None:
        self._first, self._row = array("q"), array("q")  # number and row that begin each run
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, number: int) -> None:
        """Append a row; its number is above those before."""
        if not self._first or number != self._first[-1] + self._count - self._row[-1]:
            self._first.append(number)
            self._row.append(self._count)
        self._count += 1

    def numbers(self) -> Index:
        """(K,) of all rows."""
        first, row = np.array(self._first, np.int64), np.array(self._row, np.int64)
        return np.arange(self._count) + np.repeat(first - row, np.diff(row, append=self._count))

    def find(self, numbers: Index) -> Index:
        """(n,) rows of the numbers (n,); of one without a row, that of the last one before it, of
        the first ones row 0."""
        if len(self._first) == 1 and self._first[0] == 0:
            return np.minimum(numbers, self._count - 1)
        return np.maximum(np.searchsorted(self.numbers(), numbers, side="right") - 1, 0)

    def has(self, number: int) -> bool:
        """True if there is a row of a number."""
        row = int(self.find(np.array([number]))[0])
        run = int(np.searchsorted(self._row, row, side="right")) - 1
        return self._count > 0 and self._first[run] + row - self._row[run] == number

    def select_last(self, kept: NDArray[np.bool_]) -> None:
        """Drop some of the last n rows.

        Args:
            kept: (n,) of them, those that stay.
        """
        left = self.numbers()[self._count - len(kept) :][kept]
        self._count -= len(kept)
        while self._row and self._row[-1] >= self._count:
            self._first.pop()
            self._row.pop()
        for number in left.tolist():
            self.append(number)
