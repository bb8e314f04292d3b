"""What was skipped while reading, by reason and with line numbers."""

from collections.abc import Iterable
from typing import Any

KEPT_LINES = 1000


class Skipped:
    """Counts of skipped records by reason; at most `KEPT_LINES` line numbers each."""

    def __init__(self) -> None:
        self._count: dict[str, int] = {}
        self._lines: dict[str, list[int]] = {}

    def add(self, reason: str, line: int) -> None:
        self.add_all(reason, (line,))

    def add_all(self, reason: str, lines: Iterable[int]) -> None:
        for line in lines:
            self._count[reason] = self._count.get(reason, 0) + 1
            kept = self._lines.setdefault(reason, [])
            if len(kept) < KEPT_LINES:
                kept.append(int(line))

    def merged(self, *others: "Skipped") -> "Skipped":
        """These and the others' together; neither is changed."""
        out = Skipped()
        for part in (self, *others):
            for reason, count in part._count.items():
                out._count[reason] = out._count.get(reason, 0) + count
                lines = sorted(out._lines.get(reason, []) + part._lines[reason])
                out._lines[reason] = lines[:KEPT_LINES]
        return out

    @property
    def total(self) -> int:
        return sum(self._count.values())

    def summary(self, unit: str = "line") -> str:
        """`3 x unreadable number (line 4, 8, 15)`, the most frequent reason first.

        Args:
            unit: what the numbers count.
        """
        parts = []
        for reason, count in sorted(self._count.items(), key=lambda item: -item[1]):
            shown = ", ".join(str(line) for line in sorted(self._lines[reason])[:3])
            parts.append(f"{count} x {reason} ({unit} {shown}{', ...' if count > 3 else ''})")
        return "; ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        return {
            reason: {"count": count, "lines": sorted(self._lines[reason])}
            for reason, count in self._count.items()
        }
