"""Readers, each as a function of bytes: only InputError may come out, or a sound recording."""

import random
import struct
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import containers
import corpus
import corpus_bags
import corpus_pictures
import numpy as np
import parts

from stillmap.cli import arguments
from stillmap.cli.recording_info import facts
from stillmap.core.config import load_toml, override
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.eval import readers
from stillmap.io import read
from stillmap.io.ros import reader as reader_module  # noqa: F401  (loaded now, not at the first bag)
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.options import Options
from stillmap.preprocessing.options import ReadOptions
from stillmap.results import reader as result_reader
from stillmap.results.labels import read_labels
from stillmap.results.reader import read_tracks
from stillmap.sim import load_truth

Run = Callable[[bytes, Path], None]
Change = Callable[[bytes, parts.Change, random.Random], bytes]


class Target(NamedTuple):
    """A reader that is fuzzed.

    Attributes:
        run: reads bytes, with an empty folder to put them in.
        seeds: sound inputs, made in a folder.
        change: how inputs are changed beyond single bytes; None: not at all.
    """

    run: Run
    seeds: Callable[[Path], Iterator[bytes]]
    change: Change | None = None


def require_sound(path: Path, options: ReadOptions | None = None) -> None:
    """Read a recording; what comes out is sound, and nothing is said but in words of ours."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            recording = read(path, options, scratch=path.parent)
            _walk(recording)
        except InputError as error:
            if "\n" in str(error):
                raise AssertionError("an error of several lines") from error
    assert not said, f"a library said: {said[0].message} ({said[0].filename}:{said[0].lineno})"


def _walk(recording: Recording) -> None:
    assert np.all(recording.stamp_ns[1:] >= recording.stamp_ns[:-1])
    assert recording.offset[0] == 0
    assert recording.offset[-1] == recording.n_beams
    assert np.all(recording.offset[1:] >= recording.offset[:-1])
    assert np.isfinite(recording.points[recording.hit]).all()
    assert not np.isinf(recording.points).any()
    assert np.isfinite(recording.T_base_sensor).all()
    for T in (recording.T_odom_base, recording.T_recorded_base):
        assert T is None or np.isfinite(T).all()
    assert recording.beam_time is None or np.isfinite(recording.beam_time).all()
    facts(recording)
    images = recording.images
    for image in range(min(len(images), 4) if images is not None else 0):
        try:
            assert images.read(image).ndim in (2, 3)
        except InputError:
            continue


def _file(name: str) -> Run:
    def run(data: bytes, folder: Path) -> None:
        (folder / name).write_bytes(data)
        require_sound(folder / name)

    return run


def _write(data: bytes, folder: Path, names: tuple[str, ...]) -> None:
    for name, content in zip(names, parts.split(data), strict=False):
        if content:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)


def _folder(names: tuple[str, ...]) -> Run:
    def run(data: bytes, folder: Path) -> None:
        _write(data, folder / "in", names)
        (folder / "in").mkdir(exist_ok=True)
        require_sound(folder / "in")

    return run


def _messages(encoding: str) -> Run:
    """Messages in a bag without index: their bytes alone are in question."""

    def run(data: bytes, folder: Path) -> None:
        ending = "bag" if encoding == "ros1" else "mcap"
        content = _bare_bag(data) if encoding == "ros1" else _bare_mcap(data)
        (folder / f"in.{ending}").write_bytes(content)
        require_sound(folder / f"in.{ending}")

    return run


def _each(data: bytes) -> Iterator[tuple[int, str, str, bytes]]:
    for number, part in enumerate(parts.split(data)):
        line, _, raw = part.partition(b"\n")
        kind, _, topic = line.decode("latin1").partition(" ")
        yield number, kind, topic, raw


def _bare_mcap(data: bytes) -> bytes:
    def text(word: str) -> bytes:
        return struct.pack("<I", len(word.encode())) + word.encode()

    out = b"\x89MCAP0\r\n"
    for number, kind, topic, raw in _each(data):
        n = number % 65536
        schema = struct.pack("<H", n) + text(kind) + text("") + text("")
        channel = struct.pack("<HH", n, n) + text(topic) + text("cdr") + text("")
        message = struct.pack("<HIQQ", n, 0, number, number) + raw
        for op, record in ((3, schema), (4, channel), (5, message)):
            out += bytes([op]) + struct.pack("<Q", len(record)) + record
    return out


def _bare_bag(data: bytes) -> bytes:
    def record(fields: dict[str, bytes], content: bytes) -> bytes:
        lines = [name.encode() + b"=" + value for name, value in fields.items()]
        head = b"".join(struct.pack("<I", len(line)) + line for line in lines)
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(content)) + content

    out = b"#ROSBAG V2.0\n"
    for number, kind, topic, raw in _each(data):
        n = struct.pack("<I", number)
        more = {"type": kind.replace("/msg/", "/").encode("latin1"), "md5sum": b"*"}
        inner = record(more, b"")
        size = struct.unpack_from("<I", inner)[0]
        about = {"op": b"\7", "conn": n, "topic": topic.encode("latin1") or b"/"}
        out += record(about, inner[4 : 4 + size])
        out += record({"op": b"\2", "conn": n, "time": n + n}, raw)
    return out


def _toml(data: bytes, folder: Path) -> None:
    (folder / "in.toml").write_bytes(data)
    try:
        override(Options(), load_toml(folder / "in.toml"), "in.toml")
    except InputError:
        return


def _cameras(data: bytes, folder: Path) -> None:
    """Beside a sound recording, with a folder of further pictures."""
    place = folder / "in"
    scenes = next(corpus_pictures.scenes(folder))
    _write(scenes, place, corpus_pictures.SCENES)
    _write(parts.joined([parts.split(scenes)[1], b"0.01\n"]), folder, ("more/0.png", "times.txt"))
    (folder / "in.toml").write_bytes(data)
    require_sound(place, ReadOptions(cameras=str(folder / "in.toml")))


def _rows(data: bytes, folder: Path) -> None:
    path = folder / "in.txt"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for reader in (
            read_tum,
            readers.read_planar_trajectory,
            readers.read_relations,
            readers.read_odometry,
        ):
            try:
                reader(path)
            except InputError:
                continue


def _result(data: bytes, folder: Path) -> None:
    place = folder / "result"
    _write(data, place, corpus.RESULT)
    _write(parts.joined(_OURS), place, corpus.OURS)
    for reader in (
        lambda: arguments.found(place, None).read_options,
        lambda: arguments.found(place, str(place)).read(),
        lambda: read_labels(place),
        lambda: result_reader.read_grid(place),
        lambda: read_tracks(place / "objects.json"),
        lambda: readers.read_truth(place).static_hits(),
        lambda: readers.read_truth(place).walls(),
        lambda: readers.read_truth(place).lasting(),
        lambda: load_truth(place),
    ):
        try:
            reader()
        except InputError:
            continue


_OURS: list[bytes] = []


def _results(work: Path) -> Iterator[bytes]:
    """The recording that results are of is made with them, and lies in their folder."""
    _OURS[:] = parts.split(next(corpus.ours(work / "of")))
    yield from corpus.result(work)


TARGETS = {
    "carmen": Target(_file("in.log"), corpus.carmen),
    "ours": Target(_folder(corpus.OURS), corpus.ours, parts.changed),
    "bag": Target(_file("in.bag"), corpus_bags.bag1, containers.changed_bag),
    "mcap": Target(_file("in.mcap"), corpus_bags.mcap, containers.changed_mcap),
    "db3": Target(_file("in.db3"), corpus_bags.db3, containers.changed_db3),
    "ros1": Target(_messages("ros1"), lambda _: corpus_bags.messages_of("ros1"), parts.changed),
    "cdr": Target(_messages("cdr"), lambda _: corpus_bags.messages_of("cdr"), parts.changed),
    "kitti": Target(_folder(corpus.KITTI), corpus.kitti, parts.changed),
    "drive": Target(_folder(corpus.DRIVE), corpus.drive, parts.changed),
    "pcd": Target(_file("in.pcd"), corpus.pcd, containers.changed_pcd),
    "ply": Target(_file("in.ply"), corpus.ply),
    "las": Target(_file("in.las"), corpus.las),
    "e57": Target(_file("in.e57"), corpus.e57, containers.changed_e57),
    "3dtk": Target(_folder(corpus.UOS), corpus.uos, parts.changed),
    "scenes": Target(_folder(corpus_pictures.SCENES), corpus_pictures.scenes, parts.changed),
    "tum": Target(_folder(corpus_pictures.TUM), corpus_pictures.tum, parts.changed),
    "cameras": Target(_cameras, corpus_pictures.cameras),
    "toml": Target(_toml, corpus.toml),
    "rows": Target(_rows, corpus.rows),
    "result": Target(_result, _results, parts.changed),
}
