import numpy as np
from cases import Case
from common import Run
from moving import COLUMNS, _scored
from tables import means_and_worst

SHORT = Case("short", "populated", "hall", {"robot": {"scans": 120}, "crowd": {"people": 6}})


def test_a_run_is_scored_and_shown() -> None:
    run = Run(SHORT, 0, "stillmap", ("em.max_iterations=1",), True)
    scores = _scored(run)
    assert {column.key for column in COLUMNS} <= set(scores)
    assert scores["sightings"] >= 2
    assert 50.0 < scores["whole"] <= 100.0
    assert 0.0 < scores["cost"] < 60.0
    assert scores["traffic"] > 0.5
    assert scores["speed_error"] < 0.2
    text = means_and_worst(
        [{"case": "a", **scores}, {"case": "b", **scores, "whole": float("nan")}], COLUMNS
    )
    assert text.count("\n") == 4  # a title, a line, two worlds, and all of them
    assert "nan" not in text


def test_nobody_is_no_score() -> None:
    empty = Case("nobody", "empty", "hall", {"robot": {"scans": 40}, "crowd": {"people": 0}})
    scores = _scored(Run(empty, 0, "stillmap", ("em.max_iterations=1",), True))
    assert scores["sightings"] == scores["objects"] == 0
    assert np.isnan(scores["whole"])
    assert means_and_worst([{"case": "nobody", **scores}], COLUMNS).count("| - ") >= 4
