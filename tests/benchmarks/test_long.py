import long
import numpy as np
import pytest


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return long.simulated("corridor", 12, 0, tmp_path_factory.mktemp("long"))


def test_what_is_simulated(recording):
    assert recording.n_scans == 12
    assert recording.n_beams == 12 * 1081
    np.testing.assert_array_equal(np.diff(recording.stamp_ns), 25_000_000)
    assert 0.9 < recording.hit.mean() < 1.0
    length = np.linalg.norm(recording.points, axis=1)
    np.testing.assert_allclose(length[~recording.hit], 30.0, rtol=1e-6)


def test_pieces_are_those_of_the_whole(recording, monkeypatch, tmp_path):
    monkeypatch.setattr(long, "_CHUNK", 5)
    pieces = long.simulated("corridor", 12, 0, tmp_path)
    moved = np.linalg.norm(pieces.points - recording.points, axis=1)
    assert np.median(moved) < 0.05  # other noise, the same place


def test_the_beginning(recording):
    first = long.first_scans(recording, 5)
    assert first.n_scans == len(first.T_odom_base) == 5
    np.testing.assert_array_equal(first.points, recording.points[: 5 * 1081])


def test_the_table():
    row = {
        "scans": 1000,
        "iterations": 2,
        "cpu": 9.0,
        "peak": 4e8,
        "stages": {"m_step": 4.0, "e_step": 1.0},
        "peaks": {"m_step": 2e8, "e_step": 3e8},
    }
    line = long.table([row]).splitlines()[-1]
    assert [cell.strip() for cell in line.strip("|").split("|")] == [
        *("1000", "2", "2.00", "0.50", "9.00", "200", "300", "400")
    ]
