import math

import pytest
from cases import EMPTY, POPULATED
from tables import BY_KEY, against_wanted, markdown, per_case


def row(case: str, group: str = POPULATED, **scores: float | None) -> dict[str, object]:
    return {"case": case, "group": group, **scores}


def line(table: str, *starts: str) -> list[str]:
    lines = [[cell.strip() for cell in text.split("|")[1:-1]] for text in table.splitlines()]
    return next(cells for cells in lines if cells[: len(starts)] == list(starts))


def test_cells_are_padded_to_one_width() -> None:
    widths = {len(text) for text in markdown(["a", "long"], [["value", "b"]]).splitlines()}
    assert len(widths) == 1


def test_worst_is_the_smallest_f1_and_the_largest_brier() -> None:
    rows = [row("hall", f1=0.9, brier=0.1), row("hall", f1=0.8, brier=0.3)]
    assert BY_KEY["f1"].mean_and_worst(rows) == "0.8500 (0.8000)"
    assert BY_KEY["brier"].mean_and_worst(rows) == "0.2000 (0.3000)"


def test_undefined_scores_are_left_out_of_means() -> None:
    rows = [row("hall", ap=math.nan), row("hall", ap=None), row("hall", ap=0.5)]
    assert BY_KEY["ap"].mean_and_worst(rows) == "0.5000"
    assert BY_KEY["ap"].mean_and_worst(rows[:2]) == "-"
    assert line(per_case(rows, [BY_KEY["ap"]]), "hall")[1] == "0.5000"


def test_worst_world_is_the_mean_of_its_seeds_and_the_worst_run_is_a_single_one() -> None:
    rows = [row("a", f1=1.0), row("a", f1=0.94), row("b", f1=0.96), row("b", f1=0.96)]
    cells = line(against_wanted(rows), POPULATED, "F1")
    assert cells[2:] == ["2", "0.9650", ">= 0.975", "MISSED", "0.9600", ">= 0.95", "met", "0.9400"]


def test_many_seeds_of_one_world_do_not_outweigh_another() -> None:
    rows = [row("a", brier=0.0)] * 9 + [row("b", brier=0.1)]
    assert line(against_wanted(rows), POPULATED, "Brier")[3] == "0.0500"


def test_sums_of_groups_want_all_of_them() -> None:
    table = against_wanted([row("a", f1=1.0), row("none", EMPTY, called_dynamic=0.001)])
    assert "sensors" not in table
    assert line(table, EMPTY, "called dynamic")[5] == "met"


@pytest.mark.parametrize("key", ["ap", "brier", "walls"])
def test_the_limit_itself_is_met(key: str) -> None:
    limit = {"ap": 0.99, "brier": 0.005, "walls": 0.99}[key]
    assert (
        line(against_wanted([row("a", **{key: limit})]), POPULATED, BY_KEY[key].title)[5] == "met"
    )
