"""Beams that were taken about when a picture was."""

from types import SimpleNamespace
from unittest import mock

import numpy as np
from recordings import of_one_sensor

from stillmap.core.recording import Recording
from stillmap.mesh import inputs
from stillmap.mesh.inputs import MeshInputs, TrackedBox
from stillmap.tracking.boxes import Box


def _recording(times: np.ndarray | None) -> Recording:
    T, n = 4, 3
    points = np.zeros((T * n, 3), np.float32)
    points[:, 0] = np.arange(T * n) + 1.0
    return of_one_sensor(
        np.arange(T) * 100_000_000,
        np.arange(T + 1, dtype=np.int64) * n,
        points,
        np.ones(T * n, np.bool_),
        beam_time=times,
    )


def _returns(
    recording: Recording, poses: np.ndarray, p: np.ndarray, box: Box | None, owned: np.ndarray
) -> MeshInputs:
    objects = [SimpleNamespace(id=0, beams=owned)]
    boxes = [] if box is None else [TrackedBox(box, np.zeros(2), 1.0)]
    return MeshInputs(recording, recording, poses, p, objects, boxes, 0)


def _beams(
    recording: Recording, box: Box | None = None, owned: np.ndarray | None = None
) -> MeshInputs:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 1, 3] = [0.0, 10.0, 20.0, 30.0]
    p = np.linspace(0.0, 1.0, 12).astype(np.float32)
    return _returns(recording, poses, p, box, np.zeros(0, int) if owned is None else owned)


def near_time(
    beams: MeshInputs,
    stamp_ns: int,
    window: float,
    tilting: float | None = None,
    tracked: float = 0.5,
) -> tuple[np.ndarray, np.ndarray]:
    """The returns near a time, by windows in seconds."""
    windows = {"_WINDOW": window, "_WINDOW_TILTING": tilting or window, "_WINDOW_TRACKED": tracked}
    with mock.patch.multiple(inputs, **windows):
        return beams.returns_near(stamp_ns)


def test_of_scans_taken_at_once_the_nearest_counts_at_least() -> None:
    beams = _beams(_recording(None))
    ends, p = near_time(beams, 140_000_000, 0.01)
    np.testing.assert_allclose(ends, [[4, 10, 0], [5, 10, 0], [6, 10, 0]])
    np.testing.assert_allclose(p, np.arange(3, 6) / 11.0)
    assert len(near_time(beams, 150_000_000, 0.06)[0]) == 6


def test_with_times_each_beam_counts_by_its_own() -> None:
    times = np.tile(np.array([0.0, 0.03, 0.06], np.float32), 4)
    beams = _beams(_recording(times))
    ends, _ = near_time(beams, 145_000_000, 0.02)
    np.testing.assert_allclose(ends[:, 0], [5.0, 6.0])


def test_what_is_of_a_thing_goes_on_with_it() -> None:
    along = np.array([[0.0, 0.0], [1.0, 2.0]])
    box = Box(
        0,
        np.array([0.0, 1.0]),
        along,
        np.array([[1.0, 0.0]] * 2),
        np.array([[1.0, 2.0]] * 2),
        (1.0, 1.0),
        0.5,
    )
    beams = _beams(_recording(None), box, np.array([4, 9]))
    ends, _ = near_time(beams, 140_000_000, 0.01)
    np.testing.assert_allclose(ends, [[4, 10, 0], [5.04, 10.08, 0], [6, 10, 0]], atol=1e-6)


def _row(p: list[float], planar: bool) -> MeshInputs:
    """Four rows, 0.1 s apart; beams 0, 3, 6, 9 are of a thing that goes 1 m/s along y."""
    box = Box(
        0,
        np.array([0.0, 1.0]),
        np.array([[0.0, 0.0], [0.0, 1.0]]),
        np.array([[0.0, 1.0]] * 2),
        np.array([[0.0, 1.0]] * 2),
        (1.0, 1.0),
        0.5,
    )
    poses, of_all = np.tile(np.eye(4), (4, 1, 1)), np.ones(12, np.float32)
    of_all[::3] = p
    out = _returns(_recording(None), poses, of_all, box, np.array([0, 3, 6, 9]))
    out.__dict__["is_planar"] = planar
    return out


def test_of_a_row_what_moves_is_told_longer_and_goes_on() -> None:
    windows = 0.01, 0.01, 0.15
    ends, p = near_time(_row([0.2, 0.3, 0.4, 0.1], planar=True), 100_000_000, *windows)
    np.testing.assert_allclose(ends[:, 0], [1.0, 4.0, 5.0, 6.0, 7.0])
    np.testing.assert_allclose(ends[:, 1], [0.1, 0.0, 0.0, 0.0, -0.1], atol=1e-6)
    np.testing.assert_allclose(p, [0.2, 0.3, 1.0, 1.0, 0.4])
