import numpy as np
from cases import Case
from common import Run
from evidence import _scored, by_case, by_looks

SHORT = Case("short", "populated", "hall", {"robot": {"scans": 60}, "crowd": {"people": 6}})


def test_a_run_is_scored_and_shown() -> None:
    scores = _scored(Run(SHORT, 0, "stillmap", ("em.max_iterations=1",), True))
    assert 0 < scores["thin"] < scores["known"]
    assert scores["thin"] == sum(scores[f"known {n}"] for n in range(3))
    for what in ("known", "occupied", "ghosts", "walls", "missed"):
        of_classes = [scores[f"{what} {n}"] for n in (0, 1, 2, 3, 4, 5, 7, 10, 20, 50)]
        assert sum(of_classes) == scores[what]
    assert scores["missed"] <= scores["walls"]
    assert scores["walls"] > 500
    assert 0.0 < scores["cost"] < 30.0
    some = {"case": "a", **scores, "known": 1000.0, "thin": 100.0, "ghosts": 8.0}
    rows = [{**some, "thin ghosts": 4.0}]
    assert "| 10.00   | 4 of 8       | 5.0  |" in by_case(rows)
    assert by_looks(rows).count("\n") == 11
    nothing = {**some, "ghosts": 0.0, "thin ghosts": 0.0}
    assert "| 0 of 0       | -    |" in by_case([nothing])
    assert np.isfinite(scores["cost"])
