import numpy as np
from cases import Case
from filtered import COLUMNS, Job, _rows, table, without_dynamic

from stillmap.sim import simulate

SHORT = Case("short", "populated", "hall", {"robot": {"scans": 60}, "crowd": {"people": 12}})


def test_both_recordings_are_mapped_and_shown() -> None:
    rows = _rows(Job(SHORT, 0, None, ("em.max_iterations=1",)))
    assert [(row["method"], row["given"]) for row in rows] == [
        ("hit ratio", "raw"),
        ("hit ratio", "filtered"),
    ]
    for row in rows:
        assert {column.key for column in COLUMNS} <= set(row)
        assert 0.0 <= row["translation"] < 0.2
    raw, filtered = rows
    assert filtered["ghosts"] <= raw["ghosts"]
    assert table(rows).count("short") == 2


def test_what_is_static_stays() -> None:
    recording = simulate(SHORT.build(), 0).recording
    p = np.where(np.arange(recording.n_beams) % 3 == 0, 0.4, 0.6).astype(np.float32)
    p[1] = np.nan
    cleaned = without_dynamic(recording, p)
    np.testing.assert_array_equal(cleaned.hit[0::3], False)
    for k in (1, 2):
        np.testing.assert_array_equal(cleaned.hit[k::3], recording.hit[k::3])
    assert cleaned.points is recording.points
