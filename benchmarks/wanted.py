"""Scores over worlds against the wanted figures, with and without the doors of the offices."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cases
import numpy as np
from tables import BY_KEY, NO_DOORS, OF_DOORS, Column, Row, grouped, markdown

_OFFICES = ("office", "office-moved")
WITH_DOORS = frozenset(case.name for case in cases.CASES if case.scene in _OFFICES)


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
    (cases.ONCE, (cases.ONCE,), _OF_POPULATED),
    (cases.EMPTY, (cases.EMPTY,), (Wanted("called_dynamic", 0.003, 0.003),)),
)

_HOW = (
    'Means are over worlds, each the mean of its seeds. "-": the rows do not say it of every world.'
)
_TWICE = """\
The wanted figures are for places with people. In the offices ({names})
doors open and close as well, and that a door moves cannot be known where it was seen in one state
only. So they are printed twice: (a) about people and vehicles, (b) about doors too."""
_WITHOUT = f"""\
#### (a) Movers are people and vehicles

{", ".join(c.title for c in OF_DOORS)} of the offices leave out the beams that ended on a door.
Ghosts and walls are of the whole map, door leaves included. All other worlds are as in (b)."""
_WITH = """\
#### (b) Movers are people, vehicles and doors

Every door that opens or closes is a mover from beginning to end, whether that was seen or not."""


def against_wanted(rows: Sequence[Row]) -> str:
    """Mean and worst over the worlds of each group, and whether that is what is wanted.

    Twice where some of the worlds have doors that open and close.
    """
    names = [case.name for case in cases.CASES if case.name in WITH_DOORS]
    shown = [name for name in names if any(row["case"] == name for row in rows)]
    if not shown:
        return f"{_HOW}\n\n{wanted_table(rows)}"
    about = f"{_TWICE.format(names=', '.join(shown))}\n\n{_HOW}"
    parts = [about, _WITHOUT, wanted_table(map(without_doors, rows)), _WITH, wanted_table(rows)]
    return "\n\n".join(parts)


def without_doors(row: Row) -> Row:
    """The row with the scores that leave out doors in place of those that do not.

    A score of which the row does not know that is gone from it.
    """
    if row["case"] not in WITH_DOORS:
        return row
    keys = {column.key for column in OF_DOORS}
    kept = {key: value for key, value in row.items() if key not in keys}
    return kept | {key: row[key + NO_DOORS] for key in keys if key + NO_DOORS in row}


def wanted_table(rows: Iterable[Row]) -> str:
    """One line per group and score."""
    rows, lines = list(rows), []
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
    told = sum(all(column.key in row for row in world) for world in worlds)
    if told < len(worlds):  # a mean of the others could hide a miss
        return [column.title, f"{told} of {len(worlds)}", *["-"] * 7]
    means = [float(np.mean(v)) for v in map(column.values, worlds) if v]
    if not means:
        return [column.title, "0", *["-"] * 7]
    mean, worst = float(np.mean(means)), column.worst(means)
    worst_run = column.worst(column.values(row for world in worlds for row in world))
    return [
        column.title,
        str(len(means)),
        format(mean, column.form),
        *judged(column, mean, want.mean),
        format(worst, column.form),
        *judged(column, worst, want.worst),
        format(worst_run, column.form),
    ]


def judged(column: Column, value: float, limit: float | None) -> list[str]:
    """The limit and whether it is met; nothing where there is none."""
    if limit is None:
        return ["", ""]
    met = value >= limit if column.more_is_better else value <= limit
    return [f"{'>=' if column.more_is_better else '<='} {limit:g}", "met" if met else "MISSED"]
