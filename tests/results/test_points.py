import numpy as np
import pytest

from stillmap.core import arrays
from stillmap.core.recording import Recording
from stillmap.core.se2 import matrix
from stillmap.mapping.labelled_recording import count_beams, sample_points


@pytest.fixture(params=[7, 1000, 1 << 20])
def block(request, monkeypatch):
    monkeypatch.setattr(arrays, "BLOCK", request.param)


def expected_points(recording, poses, p_static):
    """Beam by beam."""
    found = []
    for t in range(recording.n_scans):
        T = poses[t] @ recording.T_base_sensor[recording.sensor[t]]
        for n in range(recording.offset[t], recording.offset[t + 1]):
            if recording.hit[n] and p_static[n] < 0.5:
                found.append((T @ [*recording.points[n], 1])[:2])
    return np.array(found)


@pytest.fixture
def ragged():
    """Scans of different lengths, an empty one among them, from two mounted sensors."""
    rng = np.random.default_rng(1)
    lengths = [5, 0, 300, 1, 40]
    M = sum(lengths)
    recording = Recording(
        stamp_ns=np.arange(5, dtype=np.int64),
        offset=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        points=rng.normal(0, 5, (M, 2)).astype(np.float32),
        hit=rng.random(M) < 0.7,
        T_base_sensor=matrix([0.2, -0.3], [0.1, 0.0], [0.5, -2.0]),
        sensor=np.array([0, 1, 0, 1, 1], np.int32),
        T_odom_base=None,
    )
    p_static = rng.random(M).astype(np.float32)
    poses = matrix(rng.normal(0, 9, 5), rng.normal(0, 9, 5), rng.normal(0, 2, 5))
    return recording, poses, p_static


@pytest.mark.usefixtures("block")
def test_dynamic_points(ragged):
    recording, poses, p_static = ragged
    expected = expected_points(recording, poses, p_static)
    found = sample_points(recording, poses, p_static)
    assert 50 < len(found) < recording.n_beams
    np.testing.assert_allclose(found, expected, atol=1e-5)
    thin = sample_points(recording, poses, p_static, limit=10)  # an even part
    np.testing.assert_array_equal(thin, found[np.arange(10) * len(found) // 10])
    assert sample_points(recording, poses, np.ones_like(p_static)).shape == (0, 2)
    assert sample_points(recording, poses, p_static, limit=0).shape == (0, 2)


@pytest.mark.usefixtures("block")
def test_counts(result):
    recording = result.recording
    is_labelled = recording.hit | np.isnan(result.p_static)
    low_prior = np.where(is_labelled, result.p_static, np.float32(0.1))
    unusable = int(np.isnan(recording.points[:, 0]).sum())
    hits = int(recording.hit.sum())
    assert unusable == 3
    assert count_beams(recording.hit, low_prior) == {
        "beams": recording.n_beams,
        "hits": hits,
        "max_range": recording.n_beams - hits - unusable,
        "unusable": unusable,
        # a maximum-range beam carries the prior, not a label, however low it is
        "dynamic": int((recording.hit & (result.p_static < 0.5)).sum()),
    }
