import math

from tables import BY_KEY, markdown, per_case


def row(case: str, **scores: float | None) -> dict[str, object]:
    return {"case": case, **scores}


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
