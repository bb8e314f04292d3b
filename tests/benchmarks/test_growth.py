import numpy as np
import pytest
from growth import COLUMNS, Job, row_of, table


def test_every_length_is_measured_in_a_process_of_its_own() -> None:
    hoard = np.ones(80_000_000)  # 640 MB that must not count there
    rows = [row_of(Job("hall-empty", scans, 0, ("em.max_iterations=1",))) for scans in (20, 60)]
    assert hoard.nbytes > 600e6
    assert [row["scans"] for row in rows] == [20, 60]
    for row in rows:
        assert {column.key for column in COLUMNS} <= set(row)
        assert 20 < row["loaded"] <= row["peak"] < 600
        assert row["per_scan"] == pytest.approx(1e3 * row["peak"] / row["scans"])
        assert 0 < row["e_step"] < row["cpu"]
        assert row["iterations"] == 1
    assert rows[0]["metres"] < rows[1]["metres"]
    assert [line.split("|")[1].strip() for line in table(rows).splitlines()[2:]] == ["20", "60"]
