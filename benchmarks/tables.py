"""Rows of scores as Markdown tables, and against the wanted figures."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cases
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
    Column("ghosts_of_truth", "by true labels", ".2f"),
    Column("walls", "walls kept", ".4f", True),
    Column("walls_at_best", "of those in reach", ".4f", True),
    Column("walls_of_truth", "by true labels", ".4f", True),
    Column("ate", "ATE m", ".3f"),
    Column("called_dynamic", "called dynamic", ".4f"),
)
MOVERS = (
    Column("recall_people", "recall of people", ".4f", True),
    Column("recall_vehicles", "of vehicles", ".4f", True),
    Column("recall_doors", "of doors", ".4f", True),
    Column("ap_no_doors", "AP without doors", ".4f", True),
    Column("f1_no_doors", "F1 without doors", ".4f", True),
    Column("brier_no_doors", "Brier without doors", ".4f"),
)
COST = (Column("iterations", "iterations", ".1f"), Column("cpu", "CPU ms per scan", ".2f"))
PER_ITERATION = (
    Column("bound", "bound per beam", ".5f", True),
    Column("held_out", "held out per beam", ".5f", True),
    Column("seconds", "s", ".2f"),
)
BY_KEY = {column.key: column for column in (*LABELS, *MOVERS, *MAP, *COST, *PER_ITERATION)}


@dataclass(frozen=True)
class Wanted:
    """Limits of the mean over worlds and of the worst world, each the mean of its seeds."""

    key: str
    mean: float
    worst: float | None = None


_OF_ANY = (
    Wanted("ece", 0.01, 0.01),
    Wanted("ece_unsure", 0.05, 0.05),
    Wanted("ghosts", 1.0, 1.0),
    Wanted("walls", 0.99, 0.99),
    Wanted("walls_at_best", 0.99, 0.99),
)
_OF_POPULATED = (
    Wanted("ap", 0.99, 0.975),
    Wanted("f1", 0.975, 0.95),
    Wanted("brier", 0.005, 0.010),
    *_OF_ANY,
)
_EVERY_POPULATED = (cases.POPULATED, cases.SENSORS, cases.ODOMETRY)
# title, groups, and what is wanted over their cases
WANTED: tuple[tuple[str, tuple[str, ...], tuple[Wanted, ...]], ...] = (
    (cases.POPULATED, (cases.POPULATED,), _OF_POPULATED),
    (cases.SENSORS, (cases.SENSORS,), _OF_POPULATED),
    (cases.ODOMETRY, (cases.ODOMETRY,), _OF_POPULATED),
    (" + ".join(_EVERY_POPULATED), _EVERY_POPULATED, _OF_POPULATED),
    (
        cases.STOPS,
        (cases.STOPS,),
        (Wanted("ap", 0.975, 0.95), Wanted("f1", 0.95, 0.92), Wanted("brier", 0.006), *_OF_ANY),
    ),
    (cases.EMPTY, (cases.EMPTY,), (Wanted("called_dynamic", 0.003, 0.003),)),
)


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


def per_case(rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """One line per case: mean over its seeds, the worst in brackets."""
    columns = [column for column in columns if column.values(rows)]
    lines = [
        [name, *(column.mean_and_worst(of_case) for column in columns)]
        for name, of_case in grouped(rows, lambda row: row["case"]).items()
    ]
    return markdown(["case", *(column.title for column in columns)], lines)


def against_wanted(rows: Sequence[Row]) -> str:
    """Mean and worst over the worlds of each group, and whether that is what is wanted."""
    lines = []
    for title, groups, wanted in WANTED:
        of_case = grouped((r for r in rows if r["group"] in groups), lambda row: row["case"])
        if len({row["group"] for some in of_case.values() for row in some}) < len(groups):
            continue  # a sum of groups of which some were not run says nothing
        for want in wanted:
            lines.append([title, *_against(want, list(of_case.values()))])
    header = ["group", "score", "worlds", "mean", "wanted", "", "worst world", "wanted", ""]
    return markdown([*header, "worst run"], lines)


def _against(want: Wanted, worlds: Sequence[Sequence[Row]]) -> list[str]:
    column = BY_KEY[want.key]
    means = [float(np.mean(v)) for v in map(column.values, worlds) if v]
    if not means:
        return [column.title, "0", *["-"] * 7]
    mean, worst = float(np.mean(means)), column.worst(means)
    worst_run = column.worst(column.values(row for world in worlds for row in world))
    return [
        column.title,
        str(len(means)),
        format(mean, column.form),
        *_judged(column, mean, want.mean),
        format(worst, column.form),
        *_judged(column, worst, want.worst),
        format(worst_run, column.form),
    ]


def _judged(column: Column, value: float, limit: float | None) -> list[str]:
    if limit is None:
        return ["", ""]
    met = value >= limit if column.more_is_better else value <= limit
    return [f"{'>=' if column.more_is_better else '<='} {limit:g}", "met" if met else "MISSED"]
