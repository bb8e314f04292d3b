"""stillmap's own recording folder: what is written is read, what is damaged is refused."""

import json
import mmap
import os
from dataclasses import replace

import numpy as np
import pytest
from recordings import ARRAYS, of_one_sensor, require_same_arrays

from stillmap.core import arrays, se2
from stillmap.core.camera import Camera, Images
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.core.source import SensorNotes, Source
from stillmap.io import read, write
from stillmap.prepare.options import ReadOptions


def made(D=2, odometry=True, counts=(3, 0, 4), beam_times=True, recorded=True):
    rng = np.random.default_rng(4)
    T, M = len(counts), sum(counts)
    points = rng.normal(0, 5, (M, D)).astype(np.float32)
    hit = rng.random(M) < 0.7
    if M:
        points[0], hit[0] = np.nan, False
    base = np.stack([np.eye(D + 1), np.eye(D + 1)])
    base[1, 0, D] = 0.25
    odom = np.tile(np.eye(D + 1), (T, 1, 1))
    odom[:, 0, D] = rng.normal(size=T)
    return Recording(
        stamp_ns=np.arange(T, dtype=np.int64) * 10**9 + 976052857337483000,
        offset=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        points=points,
        hit=hit,
        T_base_sensor=base,
        sensor=(np.arange(T) % 2).astype(np.int32),
        T_odom_base=odom if odometry else None,
        source=Source("hall", details={"seed": 3, "nested": {"list": [1, 2.5, None, "ü"]}}),
        beam_time=rng.uniform(-0.1, 0.1, M).astype(np.float32) if beam_times else None,
        T_recorded_base=odom + np.eye(D + 1, k=D) if recorded else None,
    )


def require_same(a, b):
    require_same_arrays(a, b)
    assert a.source == b.source


@pytest.mark.parametrize("D", [2, 3])
@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize("counts", [(3, 0, 4), (0,), ()])
def test_round_trip(tmp_path, D, odometry, counts):
    recording = made(D, odometry, counts)
    write(recording, tmp_path / "rec")
    require_same(read(tmp_path / "rec"), recording)
    require_same(read(tmp_path / "rec" / "recording.json"), recording)


def test_without_odometry_beam_times_and_poses_their_files_are_absent(tmp_path):
    recording = made(odometry=False, beam_times=False, recorded=False)
    write(recording, tmp_path / "rec")
    names = {p.name for p in (tmp_path / "rec").iterdir()}
    assert names == {"recording.json", *(f"{name}.npy" for name in ARRAYS[:-3])}
    require_same(read(tmp_path / "rec"), recording)


def test_large_arrays_are_copies_on_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(arrays, "MAX_BYTES_IN_MEMORY", 16)
    write(made(), tmp_path / "rec")
    recording = read(tmp_path / "rec")
    before = np.array(recording.points)
    base = recording.points
    while isinstance(base, np.ndarray | memoryview):
        base = base.base if isinstance(base, np.ndarray) else base.obj
    assert isinstance(base, mmap.mmap)
    assert not recording.points.flags.writeable
    for file in (tmp_path / "rec").iterdir():
        os.truncate(file, 0)  # would end a process that had mapped it
    recording.release_pages()
    np.testing.assert_array_equal(recording.points, before)


def test_does_not_write_over_anything(tmp_path):
    write(made(), tmp_path / "rec")
    with pytest.raises(InputError, match="already holds"):
        write(made(3), tmp_path / "rec")
    assert read(tmp_path / "rec").dimension == 2
    write(made(3), tmp_path / "rec", overwrite=True)
    assert read(tmp_path / "rec").dimension == 3
    assert [p.name for p in tmp_path.iterdir()] == ["rec"]


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("how", ["missing", "cut", "cut header", "empty", "text", "wrong dtype"])
def test_damaged_array(tmp_path, name, how):
    write(made(), tmp_path / "rec")
    file = tmp_path / "rec" / f"{name}.npy"
    content = file.read_bytes()
    array = np.load(file)
    file.unlink()
    if how == "wrong dtype":
        np.save(file, array.astype(np.complex64))
    elif how != "missing":
        damaged = {"cut": content[:-1], "cut header": content[:20], "empty": b"", "text": b"no"}
        file.write_bytes(damaged[how])
    with pytest.raises(InputError, match=rf"{name}\.npy"):
        read(tmp_path / "rec")


def test_pickles_are_never_opened(tmp_path):
    write(made(), tmp_path / "rec")
    np.save(tmp_path / "rec" / "hit.npy", np.array([{}] * 7, object), allow_pickle=True)
    with pytest.raises(InputError, match="hit"):
        read(tmp_path / "rec")


@pytest.mark.parametrize(
    ("name", "change", "what"),
    [
        ("stamp_ns", lambda a: a[::-1].copy(), "stamps decrease"),
        (
            "stamp_ns",
            lambda a: np.where(a == a[1], np.iinfo(np.int64).max, -(2**62)),
            "stamps decrease",
        ),
        ("stamp_ns", lambda a: np.where(a == a[-1], np.iinfo(np.int64).max, a), "1824 to 2116"),
        ("stamp_ns", lambda a: np.where(a == a[0], np.iinfo(np.int64).min, a), "1824 to 2116"),
        ("offset", lambda a: a + 1, "must not decrease"),
        ("offset", lambda a: a[[0, 3, 1, 3]], "must not decrease"),
        ("offset", lambda a: np.where(a == 3, np.iinfo(np.int64).min, a), "must not decrease"),
        ("sensor", lambda a: a + 1, "sensor"),
        ("sensor", lambda a: a[:2], "expected"),
        ("points", lambda a: a * np.float32(np.nan), "is not finite"),
        ("points", lambda a: a * np.float32(np.inf), "is not finite"),
        ("points", lambda a: np.full_like(a, 3e38), "farther than 100000 m"),
        ("T_base_sensor", lambda a: a * 2.0, "rigid"),
        ("T_odom_base", lambda a: a * np.nan, "not finite"),
        ("beam_time", lambda a: a * np.float32(np.inf), "beam_time"),
        ("beam_time", lambda a: a + np.float32(1e9), "beam_time"),
        ("beam_time", lambda a: a[:2], "expected"),
    ],
)
def test_arrays_that_do_not_fit(tmp_path, name, change, what):
    write(made(), tmp_path / "rec")
    file = tmp_path / "rec" / f"{name}.npy"
    np.save(file, change(np.load(file)))
    with pytest.raises(InputError, match=what):
        read(tmp_path / "rec")


@pytest.mark.parametrize(
    "content",
    [
        *({"format": "other"}, {"format_version": 2}, {"dimension": 4}, {"scans": -1}),
        *({"sensors": True}, b"", b"{", b"\xff\xfe", b"[" * 100_000, b"3"),
    ],
)
def test_wrong_header(tmp_path, content):
    write(made(), tmp_path / "rec")
    file = tmp_path / "rec" / "recording.json"
    if isinstance(content, dict):
        content = json.dumps({**json.loads(file.read_text()), **content}).encode()
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"recording\.json"):
        read(tmp_path / "rec")


def test_options_narrow_a_folder(tmp_path):
    points = np.array([[0.1, 0], [2, 0], [6, 8], [30, 40], [np.nan] * 2], np.float32)
    hit = np.array([True, True, True, False, False])
    recording = of_one_sensor(np.zeros(1, np.int64), np.array([0, 5]), points, hit)
    write(recording, tmp_path / "rec")
    options = ReadOptions(min_range=0.5, max_range=5.0, laser_x=0.3)
    narrowed = read(tmp_path / "rec", options)
    assert narrowed.hit.tolist() == [False, True, False, False, False]
    expected = [[np.nan] * 2, [2, 0], [3, 4], [3, 4], [np.nan] * 2]
    np.testing.assert_allclose(narrowed.points, expected, rtol=1e-6)
    np.testing.assert_allclose(se2.parameters(narrowed.T_base_sensor[0]), [0.3, 0, 0])
    assert narrowed.source.read_options == {"min_range": 0.5, "max_range": 5.0, "laser_x": 0.3}


def with_images():
    """A recording with three pictures of two cameras: colour, depth in mm, depth in m."""
    rng = np.random.default_rng(1)
    pictures = [
        rng.integers(0, 256, (6, 8, 3), np.uint8),
        rng.integers(0, 65536, (4, 5), np.uint16),
        rng.random((4, 5), np.float32),
    ]
    K, T = np.diag([500.0, 500, 1]), np.eye(4)
    T[0, 3] = 0.1
    cameras = (
        Camera("front", 8, 6, K, "plumb_bob", np.array([0.1, 0.2]), T),
        Camera("depth", 5, 4, None, "", np.zeros(0), None),
    )
    stamp_ns = np.array([5, 6, 2**60], np.int64)
    images = Images(stamp_ns, np.array([0, 1, 1], np.int32), cameras, pictures.__getitem__)
    return replace(made(3), images=images), pictures


def test_pictures(tmp_path):
    recording, pictures = with_images()
    write(recording, tmp_path / "rec")
    found = read(tmp_path / "rec")
    require_same(found, recording)
    np.testing.assert_array_equal(found.images.stamp_ns, recording.images.stamp_ns)
    np.testing.assert_array_equal(found.images.camera, recording.images.camera)
    for i, picture in enumerate(pictures):
        again = found.images.read(i)
        assert again.dtype == picture.dtype
        np.testing.assert_array_equal(again, picture)
    for camera, wanted in zip(found.images.cameras, recording.images.cameras, strict=True):
        assert str(camera) == str(wanted)
    write(found, tmp_path / "again")
    for file in (tmp_path / "rec" / "images").iterdir():
        assert (tmp_path / "again" / "images" / file.name).read_bytes() == file.read_bytes()
    (tmp_path / "rec/images/000000.png").write_bytes(b"nothing")
    (tmp_path / "rec/images/000002.npy").write_bytes(b"nothing")
    for i in (0, 2):
        with pytest.raises(InputError, match=f"00000{i}"):
            read(tmp_path / "rec").images.read(i)
        (next((tmp_path / "rec/images").glob(f"00000{i}.*"))).unlink()
        with pytest.raises(InputError, match=rf"00000{i}\.png: cannot be read: No such file"):
            read(tmp_path / "rec").images.read(i)


def test_pictures_that_cannot_be_read_are_left_out(tmp_path):
    recording, pictures = with_images()

    def load(image):
        if image == 1:
            raise InputError("is no picture", where="1.png")
        return pictures[image]

    write(replace(recording, images=replace(recording.images, load=load)), tmp_path / "rec")
    found = read(tmp_path / "rec")
    assert found.images.stamp_ns.tolist() == [5, 2**60]
    np.testing.assert_array_equal(found.images.read(1), pictures[2])
    assert found.source.warnings == ["1 images left out: 1.png: is no picture"]


@pytest.mark.parametrize(
    "changed", [{"images": 2}, {"cameras": None}, {"cameras": []}, {"cameras": [{"name": "a"}] * 2}]
)
def test_headers_that_lie_about_pictures(tmp_path, changed):
    write(with_images()[0], tmp_path / "rec")
    file = tmp_path / "rec" / "recording.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changed))
    with pytest.raises(InputError):
        read(tmp_path / "rec")


@pytest.mark.parametrize("grid", [(5, 5), (0, 0), (-1, -1)])
def test_grids_that_scans_do_not_have_are_not_levelled(tmp_path, grid):
    recording = made(D=3, counts=(12, 12))
    sensors = [SensorNotes("depth", grid=grid)]
    write(replace(recording, source=Source(sensors=sensors)), tmp_path / "rec")
    again = read(tmp_path / "rec")
    assert "levelled" not in again.source.details
    np.testing.assert_array_equal(again.T_recorded_base, recording.T_recorded_base)
