import pytest
from cases import CASES, EMPTY, ONCE, POPULATED, STOPS
from tables import BY_KEY, OF_DOORS, Column
from wanted import WITH_DOORS, against_wanted, wanted_table

# scores of an office whose doors nobody could know, and without those doors
_MISSED = {"ap": 0.5, "f1": 0.4, "brier": 0.06, "ece": 0.05, "ece_unsure": 0.4}
_PERFECT = {"ap_no_doors": 1.0, "f1_no_doors": 1.0, "brier_no_doors": 0.0, "ece_no_doors": 0.0}
_OFFICE = {**_MISSED, **_PERFECT, "ece_unsure_no_doors": 0.02}
_HALL = {"ap": 1.0, "f1": 0.98, "brier": 0.002, "ece": 0.004, "ece_unsure": 0.04}


def row(case: str, group: str = POPULATED, **scores: float | None) -> dict[str, object]:
    return {"case": case, "group": group, **scores}


def line(table: str, *starts: str) -> list[str]:
    lines = [[cell.strip() for cell in text.split("|")[1:-1]] for text in table.splitlines()]
    return next(cells for cells in lines if cells[: len(starts)] == list(starts))


def both(rows: list[dict[str, object]]) -> tuple[str, str]:
    """What is printed about people and vehicles, and what about doors too."""
    about, with_doors = against_wanted(rows).split("#### (b)")
    return about.split("#### (a)")[1], with_doors


def test_worst_world_is_the_mean_of_its_seeds_and_the_worst_run_is_a_single_one() -> None:
    rows = [row("a", f1=1.0), row("a", f1=0.94), row("b", f1=0.96), row("b", f1=0.96)]
    cells = line(wanted_table(rows), POPULATED, "F1")
    assert cells[2:] == ["2", "0.9650", ">= 0.975", "MISSED", "0.9600", ">= 0.95", "met", "0.9400"]


def test_many_seeds_of_one_world_do_not_outweigh_another() -> None:
    rows = [row("a", brier=0.0)] * 9 + [row("b", brier=0.1)]
    assert line(wanted_table(rows), POPULATED, "Brier")[3] == "0.0500"


def test_sums_of_groups_want_all_of_them() -> None:
    table = wanted_table([row("a", f1=1.0), row("none", EMPTY, called_dynamic=0.001)])
    assert "sensors" not in table
    assert line(table, EMPTY, "called dynamic")[5] == "met"


@pytest.mark.parametrize("key", ["ap", "brier", "walls"])
def test_the_limit_itself_is_met(key: str) -> None:
    limit = {"ap": 0.99, "brier": 0.005, "walls": 0.99}[key]
    table = wanted_table([row("a", **{key: limit})])
    assert line(table, POPULATED, BY_KEY[key].title)[5] == "met"


def test_undefined_scores_are_left_out_and_counted() -> None:
    cells = line(wanted_table([row("a", ap=None), row("b", ap=1.0)]), POPULATED, "AP")
    assert cells[2:4] == ["1", "1.0000"]


@pytest.mark.parametrize(("group", "office"), [(POPULATED, "office-10"), (STOPS, "office-stops")])
@pytest.mark.parametrize("column", OF_DOORS, ids=lambda column: column.key)
def test_offices_count_without_their_doors_and_once_more_with_them(
    group: str, office: str, column: Column
) -> None:
    rows = [row("other", group, **_HALL), row(office, group, **_OFFICE)]
    without, with_doors = (line(part, group, column.title) for part in both(rows))
    mean = {key: (_HALL[key] + _OFFICE[f"{key}_no_doors"]) / 2 for key in _HALL}[column.key]
    assert without[2:4] == ["2", format(mean, column.form)]
    assert "MISSED" not in without
    assert with_doors[2] == "2"
    assert with_doors[6] == format(_MISSED[column.key], column.form)
    assert "MISSED" in with_doors


def test_other_worlds_are_the_same_in_both() -> None:
    # whatever their rows say without doors: they have none that open
    rows = [row("hall-15", **_HALL, f1_no_doors=0.1), row("office-stops", STOPS, **_OFFICE)]
    without, with_doors = (line(part, POPULATED, "F1") for part in both(rows))
    assert without == with_doors
    assert without[3] == "0.9800"


def test_worlds_whose_doors_swing_are_those_told_by_name() -> None:
    offices = [case for case in CASES if case.build().leaves]
    assert {case.name for case in offices} == WITH_DOORS
    assert len(offices) >= 4
    text = against_wanted([row(case.name, case.group, **_OFFICE) for case in offices])
    assert all(case.name in text.split("#### (a)")[0] for case in offices)


def test_one_table_where_no_door_opens() -> None:
    text = against_wanted([row("hall-15", **_HALL)])
    assert "(a)" not in text
    assert "doors" not in text
    assert line(text, POPULATED, "F1")[3] == "0.9800"


def test_rows_from_before_a_score_was_known_hide_nothing_and_crash_nothing() -> None:
    old = {key: value for key, value in _OFFICE.items() if key != "ece_no_doors"}
    rows = [row("hall-15", **_HALL), row("office-10", **_OFFICE), row("office-10", **old)]
    without, with_doors = both(rows)
    assert line(without, POPULATED, "ECE")[2:] == ["1 of 2", *["-"] * 7]
    assert line(without, POPULATED, "Brier")[2:4] == ["2", "0.0010"]
    assert line(with_doors, POPULATED, "ECE")[3] == "0.0270"


def test_cars_that_are_passed_once_and_empty_places_are_rows_of_their_own() -> None:
    rows = [row("hall-15", **_HALL), row("street-turn", ONCE, **_MISSED)]
    rows.append(row("office-empty", EMPTY, called_dynamic=0.01))
    table = against_wanted(rows)
    assert line(table, ONCE, "AP")[5] == "MISSED"
    assert line(table, EMPTY, "called dynamic")[5] == "MISSED"
    assert line(table, POPULATED, "AP")[2:4] == ["1", "1.0000"]
