"""Rows of scores as Markdown tables."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """A score: its key in a row, its title, how it is printed, and whether more is better."""

    key: str
    title: str
    form: str
    more_is_better: bool = False

    def values(self, rows: Iterable[Row]) -> list[float]:
        """Those that are defined."""
        given = [row.get(self.key) for row in rows]
        return [float(v) for v in given if v is not None and not np.isnan(v)]

    def worst(self, values: Sequence[float]) -> float:
        return min(values) if self.more_is_better else max(values)

    def mean_and_worst(self, rows: Iterable[Row]) -> str:
        values = self.values(rows)
        if not values:
            return "-"
        mean = format(np.mean(values), self.form)
        return f"{mean} ({self.worst(values):{self.form}})" if len(values) > 1 else mean


LABELS = (
    Column("ap", "AP", ".4f", True),
    Column("f1", "F1", ".4f", True),
    Column("precision", "precision", ".4f", True),
    Column("recall", "recall", ".4f", True),
    Column("brier", "Brier", ".4f"),
    Column("ece", "ECE", ".4f"),
    Column("ece_unsure", "ECE unsure", ".3f"),
    Column("log_loss", "log loss", ".4f"),
)
MAP = (
    Column("ghosts", "ghosts per 100 m2", ".2f"),
    Column("ghost_cells", "ghost cells", ".0f"),
    Column("free_area", "free m2", ".0f"),
    Column("ghosts_of_truth", "by true labels", ".2f"),
    Column("walls", "walls kept", ".4f", True),
    Column("walls_at_best", "of those in reach", ".4f", True),
    Column("walls_of_truth", "by true labels", ".4f", True),
    Column("ate", "ATE m", ".3f"),
    Column("called_dynamic", "called dynamic", ".4f"),
)
# labels scored again where doors open and close: without the beams on doors, and on things
OF_DOORS = tuple(c for c in LABELS if c.key in ("ap", "f1", "brier", "ece", "ece_unsure"))
NO_DOORS = "_no_doors"
MOVERS = (
    Column("recall_people", "recall of people", ".4f", True),
    Column("recall_vehicles", "of vehicles", ".4f", True),
    Column("recall_doors", "of doors", ".4f", True),
    Column("recall_things", "of things", ".4f", True),
    *(replace(c, key=c.key + NO_DOORS, title=f"{c.title} without doors") for c in OF_DOORS),
)
COST = (Column("iterations", "iterations", ".1f"), Column("cpu", "CPU ms per scan", ".2f"))
BY_KEY = {column.key: column for column in (*LABELS, *MOVERS, *MAP, *COST)}


def markdown(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table; every column as wide as its widest cell."""
    cells = [list(header), *(list(line) for line in lines)]
    width = [max(len(row[k]) for row in cells) for k in range(len(header))]
    padded = [
        "| " + " | ".join(c.ljust(w) for c, w in zip(row, width, strict=True)) + " |"
        for row in cells
    ]
    return "\n".join([padded[0], "|" + "|".join("-" * (w + 2) for w in width) + "|", *padded[1:]])


def grouped(rows: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    """Rows that have a key in common, keys in the order of their first row."""
    out: dict[Any, list[Row]] = {}
    for row in rows:
        out.setdefault(key(row), []).append(row)
    return out


def means_and_worst(rows: Iterable[Row], columns: Sequence[Column]) -> str:
    """A line for every case, and one for all of them: means, and in brackets the worst."""
    rows = list(rows)
    columns = [column for column in columns if column.values(rows)]
    groups = {**grouped(rows, lambda row: str(row["case"])), "all": rows}
    lines = [
        [name, *(column.mean_and_worst(some) for column in columns)]
        for name, some in groups.items()
    ]
    return markdown(["case", *(column.title for column in columns)], lines)
