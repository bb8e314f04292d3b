"""Recordings that do not fit into memory: the same result, a piece at a time."""

import dataclasses

import numpy as np
import pytest

import stillmap
from stillmap.core import arrays, chunks, tiles
from stillmap.core.config import override
from stillmap.results.writer import save

ESTIMATORS = ("stillmap", "paper", "hit-ratio", "tracker")


@pytest.fixture
def swept(room):
    """The room as a laser sees it that takes a while for each scan."""
    recording = room.recording
    times = np.tile(np.linspace(0.0, 0.1, 120, dtype=np.float32), recording.n_scans)
    return dataclasses.replace(recording, beam_time=times)


def files_of(recording, estimator, out):
    """All that a run writes, but for what tells of time and memory."""
    options = override(
        stillmap.Options(),
        {"threads": 1, "estimator": estimator, "em": {"max_iterations": 2, "held_out": 5}},
    )
    save(stillmap.build(recording, options, scratch=out.parent), out)
    names = [file for file in out.rglob("*") if file.is_file()]
    return {
        str(file.relative_to(out)): file.read_bytes()
        for file in names
        if file.name not in ("run.json", "report.html")
    }


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_arrays_in_files_give_the_same_bytes(swept, estimator, tmp_path, monkeypatch):
    in_memory = files_of(swept, estimator, tmp_path / "in memory")
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", 0)
    monkeypatch.setattr(tiles, "MAX_DENSE_BYTES", 0)
    assert files_of(swept, estimator, tmp_path / "in files") == in_memory
    assert {path.name for path in tmp_path.iterdir()} == {"in memory", "in files"}


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_pieces_of_any_size_give_the_same_bytes(swept, estimator, tmp_path, monkeypatch):
    whole = files_of(swept, estimator, tmp_path / "whole")
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", 0)
    monkeypatch.setattr(tiles, "MAX_DENSE_BYTES", 0)
    monkeypatch.setattr(arrays, "BLOCK", 1000)
    monkeypatch.setattr(chunks, "CHUNK_BEAMS", 700)
    monkeypatch.setattr(arrays, "ITEMS_PER_RELEASE", 3)
    assert files_of(swept, estimator, tmp_path / "pieces") == whole
