import dataclasses
import gc
import zipfile

import numpy as np
import pytest

from stillmap.core.arrays import write_npz
from stillmap.results.map_server import write_map_npz


def test_content(tmp_path, result):
    write_map_npz(tmp_path / "map.npz", result.map)
    floats = {name: getattr(result.map, name) for name in ("p_occupied", "alpha", "beta")}
    with np.load(tmp_path / "map.npz", allow_pickle=False) as read:
        assert set(read) == {*floats, "changed", "origin", "resolution"}
        for name, layer in floats.items():
            np.testing.assert_array_equal(read[name], np.asarray(layer, np.float32))
            assert read[name].dtype == np.float32
        assert np.isnan(read["p_occupied"]).any()
        np.testing.assert_array_equal(read["origin"], result.map.origin)
        assert float(read["resolution"]) == result.map.resolution
    evidence = result.evidence
    counts = {"looks": evidence.observations, "clear_looks": evidence.unobstructed}
    write_map_npz(tmp_path / "map.npz", result.map, (), evidence)
    with np.load(tmp_path / "map.npz", allow_pickle=False) as read:
        assert set(read) == {*floats, *counts, "thin", "changed", "origin", "resolution"}
        for name, layer in counts.items():
            np.testing.assert_array_equal(read[name], layer)
            assert read[name].dtype == np.uint16
        np.testing.assert_array_equal(read["thin"], evidence.thinly_observed)
        assert read["thin"].dtype == np.bool_


def test_equal_maps_give_equal_bytes_whatever_their_layout(tmp_path, result):
    write_map_npz(tmp_path / "a.npz", result.map)
    other = dataclasses.replace(result.map, p_occupied=result.map.p_occupied.copy())
    write_map_npz(tmp_path / "b.npz", other)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


# the writer of an array that was never created is finalized; Python 3.13 warns
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("stopped", [KeyboardInterrupt, SystemExit, OSError("disk full")])
@pytest.mark.parametrize("within", ["_get_compressor", "_ZipWriteFile.write"])
def test_whatever_stops_it_is_what_is_said(tmp_path, monkeypatch, stopped, within):
    # Ctrl-C while an array is half open must not turn into an error about that
    done = []

    def stop(*_):
        done.append(True)
        raise stopped

    monkeypatch.setattr(f"zipfile.{within}", stop)
    with pytest.raises(BaseException) as caught:  # noqa: PT011
        write_npz(tmp_path / "a.npz", {"a": np.zeros(3), "b": np.zeros(3)})
    assert caught.type is (stopped if isinstance(stopped, type) else type(stopped))
    assert done == [True]
    del caught
    gc.collect()  # the writer, within this test
