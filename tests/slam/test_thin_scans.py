"""Planar scans with more beams than registration needs."""

import numpy as np

from stillmap.core.recording import Recording
from stillmap.slam.scan_hits import thin_scans


def scans(*counts):
    offset = np.cumsum([0, *counts])
    points = np.arange(2 * offset[-1], dtype=np.float32).reshape(-1, 2)
    T = len(counts)
    return Recording(
        stamp_ns=np.arange(T),
        offset=offset,
        points=points,
        hit=points[:, 0] % 3 > 0,
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(T, np.int32),
        T_odom_base=np.tile(np.eye(3), (T, 1, 1)),
        beam_time=1e-3 * points[:, 1],
    )


def test_few_beams_stay_themselves():
    recording, e = scans(2048, 180), np.ones(2228, np.float32)
    found = thin_scans(recording, e)
    assert found[0] is recording
    assert found[1] is e


def test_every_so_many_beams_of_dense_scans_are_kept():
    recording = scans(100, 20_000)
    e = np.arange(20_100, dtype=np.float32)
    thinned, weights = thin_scans(recording, e)
    kept = np.concatenate([np.arange(100), np.arange(100, 20_100, 10)])
    np.testing.assert_array_equal(weights, kept)
    for name in ("points", "hit", "beam_time"):
        np.testing.assert_array_equal(getattr(thinned, name), getattr(recording, name)[kept])
    assert np.diff(thinned.offset).tolist() == [100, 2000]
    assert thinned.n_scans == recording.n_scans
