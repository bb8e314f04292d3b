import dataclasses
import json

import numpy as np
import pytest
import result_contents
from flat import files_of

from stillmap.core.errors import InputError
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.options import OutputOptions
from stillmap.results import writer as save_module
from stillmap.results.writer import save
from stillmap.tracking import ObjectOptions

FILES = {
    *result_contents.FILES,
    "graph.g2o",
    "objects/objects.json",
    "objects/0000.ply",
    "objects/0001.ply",
    "traffic.npz",
}


def test_the_folder_is_complete_and_agrees_with_itself(tmp_path, result):
    save(result, tmp_path / "out")
    files = files_of(tmp_path / "out")
    assert set(files) == FILES
    run = json.loads(files["run.json"])
    stamps, _ = read_tum(tmp_path / "out/trajectory.tum")
    np.testing.assert_array_equal(stamps, np.load(tmp_path / "out/beams/stamp_ns.npy"))
    assert run["counts"]["scans"] == len(stamps)
    assert run["counts"]["beams"] == len(np.load(tmp_path / "out/beams/hit.npy"))
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_files_follow_the_options(tmp_path, result):
    def written(**changes):
        options = dataclasses.replace(result.options, **changes)
        save(dataclasses.replace(result, options=options, graph=None), tmp_path / "out", True)
        return set(files_of(tmp_path / "out"))

    assert written() == FILES - {"graph.g2o"}
    moving = {name for name in FILES if name.startswith(("objects/", "traffic"))}
    assert written(objects=ObjectOptions(enabled=False)) == FILES - moving - {"graph.g2o"}
    scale = written(output=OutputOptions(map_mode="scale"))
    assert scale == FILES - {"graph.g2o", "map.pgm"} | {"map.png"}


def test_same_result_same_bytes_except_for_timings(tmp_path, result):
    slower = {name: {**stage, "seconds": 99.0} for name, stage in result.stages.items()}
    save(result, tmp_path / "a")
    save(result, tmp_path / "b")
    save(dataclasses.replace(result, stages=slower), tmp_path / "c")
    a, b, c = (files_of(tmp_path / name) for name in "abc")
    assert a == b
    assert {name for name in FILES if a[name] != c[name]} == {"run.json", "report.html"}


@pytest.mark.parametrize("kind", [KeyboardInterrupt, RuntimeError, MemoryError])
def test_a_save_that_fails_leaves_nothing(tmp_path, result, monkeypatch, kind):
    def fail(*_):
        raise kind

    monkeypatch.setattr(save_module, "run_record", fail)
    with pytest.raises(kind):
        save(result, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_save_that_fails_keeps_what_was_there(tmp_path, result, monkeypatch):
    save(result, tmp_path / "out")
    before = files_of(tmp_path / "out")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(save_module, "render_report", full)
    with pytest.raises(InputError, match="No space left"):
        save(result, tmp_path / "out", overwrite=True)
    assert files_of(tmp_path / "out") == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_overwriting_must_be_asked_for(tmp_path, result):
    (tmp_path / "out").mkdir()
    save(result, tmp_path / "out")  # an empty folder is as good as none
    (tmp_path / "out" / "mine.txt").write_text("kept")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "mine.txt").write_text("kept")
    with pytest.raises(InputError, match=r"other things: only a folder with run\.json"):
        save(result, tmp_path / "mine", overwrite=True)
    assert (tmp_path / "mine" / "mine.txt").read_text() == "kept"
    with pytest.raises(InputError, match="already holds"):
        save(result, tmp_path / "out")
    assert (tmp_path / "out" / "mine.txt").read_text() == "kept"
    save(result, tmp_path / "out", overwrite=True)
    assert set(files_of(tmp_path / "out")) == FILES
