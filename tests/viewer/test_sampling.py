"""Subsampling of point clouds for the viewer."""

import numpy as np
import pytest

from stillmap.core.arrays import sample_indices
from stillmap.core.errors import InputError
from stillmap.results.points import ply_header
from stillmap.results.viewer.scene import sample_ply


def test_sample_contains_every_lidar_ring():
    """At even steps 16 rings that come in turn would show one of them."""
    rings = np.bincount(sample_indices(160_000, 10_000) % 16, minlength=16)
    assert rings.min() > 400


def written(path, rows, fields):
    path.write_bytes(ply_header(fields, len(rows)) + rows.tobytes())
    return path


def test_sampled_points_of_a_file(tmp_path):
    fields = [(name, "<f4") for name in ("x", "y", "z", "p_static")]
    rows = np.zeros(600_000, fields)  # more than are read at a time
    rows["x"], rows["z"] = np.arange(len(rows)), 2.0
    found = sample_ply(written(tmp_path / "a.ply", rows, fields), 1000)
    assert np.array_equal(found.points[:, 0], sample_indices(len(rows), 1000))
    assert (found.points[:, 1:] == [0.0, 2.0]).all()
    assert (found.colors, found.total) == (None, 600_000)


def test_colors_of_a_file(tmp_path):
    head = b"ply\nformat ascii 1.0\nelement vertex 2\n"
    head += b"".join(b"property float %c\n" % name for name in b"xyz")
    head += b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head + b"0 0 0 1 2 3\n1 1 1 250 251 252\n")
    found = sample_ply(tmp_path / "a.ply", 10)
    assert found.colors.tolist() == [[1, 2, 3], [250, 251, 252]]


def test_point_that_is_not_finite_is_refused(tmp_path):
    fields = [(name, "<f4") for name in ("x", "y", "z")]
    rows = np.zeros(3, fields)
    rows["y"][1] = np.nan
    with pytest.raises(InputError, match="not finite"):
        sample_ply(written(tmp_path / "a.ply", rows, fields), 10)
