import dataclasses
import zipfile

import numpy as np

from stillmap.output.map_npz import write_map_npz


def test_content(tmp_path, result):
    write_map_npz(tmp_path / "map.npz", result.map)
    with np.load(tmp_path / "map.npz", allow_pickle=False) as read:
        assert set(read) == {"p_occupied", "alpha", "beta", "changed", "origin", "resolution"}
        np.testing.assert_array_equal(read["p_occupied"], result.map.p_occupied)
        assert read["p_occupied"].dtype == np.float32
        assert np.isnan(read["p_occupied"]).any()
        for name in ("alpha", "beta"):
            sums = np.asarray(getattr(result.map, name), np.float32)
            np.testing.assert_array_equal(read[name], sums)
            assert read[name].dtype == np.float32
        np.testing.assert_array_equal(read["origin"], result.map.origin)
        assert float(read["resolution"]) == result.map.resolution


def test_equal_maps_give_equal_bytes_whatever_their_layout(tmp_path, result):
    write_map_npz(tmp_path / "a.npz", result.map)
    other = dataclasses.replace(result.map, p_occupied=result.map.p_occupied.copy())
    write_map_npz(tmp_path / "b.npz", other)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
