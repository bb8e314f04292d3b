"""A part of a recording by time: the same scans whatever the format."""

import numpy as np
import pytest
from cut_recordings import CASES, PERIOD, START, N, make_recording, write_whole

from stillmap.core.errors import InputError
from stillmap.io import read
from stillmap.prepare.options import ReadOptions

T = 60


@pytest.mark.parametrize(("dimension", "form"), CASES)
def test_a_part_holds_the_scans_between_its_limits(dimension, form, tmp_path):
    path = write_whole(make_recording(dimension), tmp_path, form)
    whole = read(path)
    for start, end, first, last in (
        (0.5, 1.0, 5, 10),  # both limits included
        (None, 0.35, 0, 3),
        (2.5, None, 25, T - 1),
        (0.0, 99.0, 0, T - 1),
        (START + 0.5, START + 1.0, 5, 10),  # stamps
        (START + 0.5, 1.0, 5, 10),
    ):
        part = read(path, ReadOptions(start=start, end=end))
        rows, beams = slice(first, last + 1), slice(first * N, (last + 1) * N)
        np.testing.assert_array_equal(part.stamp_ns, whole.stamp_ns[rows])
        np.testing.assert_array_equal(part.points, whole.points[beams])
        np.testing.assert_array_equal(part.hit, whole.hit[beams])
        if whole.T_odom_base is not None:
            np.testing.assert_allclose(part.T_odom_base, whole.T_odom_base[rows], atol=1e-9)
        noted = part.source.part
        assert noted.omitted == T - part.n_scans
        assert noted.last_stamp_ns - noted.first_stamp_ns == (T - 1) * int(1e9 * PERIOD)


@pytest.mark.parametrize(("dimension", "form"), CASES)
def test_an_empty_part_names_the_span(dimension, form, tmp_path):
    path = write_whole(make_recording(dimension), tmp_path, form)
    for start, end in ((10.0, None), (0.31, 0.39), (1.0, 0.5), (None, START - 5.0)):
        with pytest.raises(InputError, match=r"has no scan .*spans 0 to 5\.90 s") as caught:
            read(path, ReadOptions(start=start, end=end))
        assert caught.value.where == str(path)
        assert f"stamps {START}.000000000 to {START + 5}.900000000" in str(caught.value)


def test_clouds_outside_are_not_opened(tmp_path):
    path = write_whole(make_recording(3), tmp_path, "kitti")
    (path / "velodyne" / "000000.bin").write_bytes(b"no cloud")
    part = read(path, ReadOptions(start=1.0))
    assert part.n_scans == T - 10
    assert part.source.skipped == {}


def test_a_second_sensor_may_begin_earlier(tmp_path):
    """Times count from the first scan that is read; without a start nothing before it is lost."""
    lines = ["RLASER 2 1 2 0 0 0 0 0 0 10.2 host 0", "FLASER 2 1 2 0 0 0 0 0 0 10.1 host 0"]
    lines += ["FLASER 2 1 2 0 0 0 0 0 0 11.1 host 0", "RLASER 2 1 2 0 0 0 0 0 0 11.2 host 0"]
    path = tmp_path / "two.log"
    path.write_text("".join(f"{line}\n" for line in lines))
    for start, count in ((None, 4), (0.0, 4), (0.9, 2), (1.0, 1)):
        assert read(path, ReadOptions(start=start)).n_scans == count
    assert read(path, ReadOptions(end=0.5)).n_scans == 2
