"""Readers as functions of bytes: they may raise InputError only, or return a valid recording."""

import random
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import containers
import corpus
import corpus_bags
import corpus_images
import numpy as np
import parts

from stillmap.cli.recording_info import summarize_recording
from stillmap.core.config import load_toml, override
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io import read
from stillmap.io.ros import reader as reader_module  # noqa: F401  (instrumented at import)
from stillmap.io.trajectory import read_tum
from stillmap.pipeline.options import Options
from stillmap.prepare.options import ReadOptions
from stillmap.results import reader as result_reader
from stillmap.results.eval import readers
from stillmap.results.folder import open_result
from stillmap.results.reader import read_labels, read_tracks
from stillmap.sim import load_truth

Run = Callable[[bytes, Path], None]
Mutate = Callable[[bytes, parts.Mutation, random.Random], bytes]


class Target(NamedTuple):
    """A reader to fuzz.

    Attributes:
        run: reads bytes, by way of an empty folder.
        seeds: creates valid inputs in a folder.
        mutate: mutates inputs beyond single bytes; None: libFuzzer does.
    """

    run: Run
    seeds: Callable[[Path], Iterator[bytes]]
    mutate: Mutate | None = None


def require_valid(path: Path, options: ReadOptions | None = None) -> None:
    """Read a recording: it is valid or refused in one line, and libraries do not warn."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            recording = read(path, options, scratch=path.parent)
            _check_recording(recording)
        except InputError as error:
            if "\n" in str(error):
                raise AssertionError("an error of several lines") from error
    assert not said, f"a library said: {said[0].message} ({said[0].filename}:{said[0].lineno})"


def _check_recording(recording: Recording) -> None:
    assert np.all(recording.stamp_ns[1:] >= recording.stamp_ns[:-1])
    assert recording.offset[0] == 0
    assert recording.offset[-1] == recording.n_beams
    assert np.all(recording.offset[1:] >= recording.offset[:-1])
    assert np.isfinite(recording.points[recording.hit]).all()
    assert not np.isinf(recording.points).any()
    assert np.isfinite(recording.T_base_sensor).all()
    for numbers in (recording.T_odom_base, recording.T_recorded_base, recording.beam_time):
        assert numbers is None or np.isfinite(numbers).all()
    summarize_recording(recording)
    images = recording.images
    for image in range(min(len(images), 4) if images is not None else 0):
        with suppress(InputError):
            assert images.read(image).ndim in (2, 3)


def _file(name: str) -> Run:
    def run(data: bytes, folder: Path) -> None:
        (folder / name).write_bytes(data)
        require_valid(folder / name)

    return run


def _write(data: bytes, folder: Path, names: tuple[str, ...]) -> None:
    for name, content in zip(names, parts.split_parts(data), strict=False):
        if content:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)


def _folder(names: tuple[str, ...]) -> Run:
    def run(data: bytes, folder: Path) -> None:
        _write(data, folder / "in", names)
        (folder / "in").mkdir(exist_ok=True)
        require_valid(folder / "in")

    return run


def _messages(encoding: str) -> Run:
    """Messages in a bag without an index, so that only their content is mutated."""

    def run(data: bytes, folder: Path) -> None:
        ending = "bag" if encoding == "ros1" else "mcap"
        content = _unindexed_bag(data) if encoding == "ros1" else _unindexed_mcap(data)
        (folder / f"in.{ending}").write_bytes(content)
        require_valid(folder / f"in.{ending}")

    return run


def _each(data: bytes) -> Iterator[tuple[int, str, str, bytes]]:
    for number, part in enumerate(parts.split_parts(data)):
        line, _, raw = part.partition(b"\n")
        kind, _, topic = line.decode("latin1").partition(" ")
        yield number, kind, topic, raw


def _unindexed_mcap(data: bytes) -> bytes:
    def text(word: str) -> bytes:
        return struct.pack("<I", len(word.encode())) + word.encode()

    records = []
    for number, kind, topic, raw in _each(data):
        n = number % 65536
        schema = struct.pack("<H", n) + text(kind) + text("") + text("")
        channel = struct.pack("<HH", n, n) + text(topic) + text("cdr") + text("")
        message = struct.pack("<HIQQ", n, 0, number, number) + raw
        records += [(3, schema), (4, channel), (5, message)]
    return b"\x89MCAP0\r\n" + containers.join_mcap(records)


def _unindexed_bag(data: bytes) -> bytes:
    head, records = containers.make_head, []
    for number, kind, topic, raw in _each(data):
        n = struct.pack("<I", number)
        type = kind.replace("/msg/", "/").encode("latin1")
        about = {b"op": b"\7", b"conn": n, b"topic": topic.encode("latin1") or b"/"}
        records.append((head(about), head({b"type": type, b"md5sum": b"*"})))
        records.append((head({b"op": b"\2", b"conn": n, b"time": n + n}), raw))
    return b"#ROSBAG V2.0\n" + containers.join_bag(records)


def _toml(data: bytes, folder: Path) -> None:
    (folder / "in.toml").write_bytes(data)
    with suppress(InputError):
        override(Options(), load_toml(folder / "in.toml"), "in.toml")


def _cameras(data: bytes, folder: Path) -> None:
    """A camera file for a valid recording, with a folder of further images."""
    place = folder / "in"
    scenes = next(corpus_images.scenes(folder))
    _write(scenes, place, corpus_images.SCENES)
    more = parts.join_parts([parts.split_parts(scenes)[1], b"0.01\n"])
    _write(more, folder, ("more/0.png", "times.txt"))
    (folder / "in.toml").write_bytes(data)
    require_valid(place, ReadOptions(cameras=str(folder / "in.toml")))


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
            with suppress(InputError):
                reader(path)


def _result(data: bytes, folder: Path) -> None:
    place = folder / "result"
    _write(data, place, corpus.RESULT)
    _write(parts.join_parts(_recording_files), place, corpus.STILLMAP)
    for reader in (
        lambda: open_result(place, None).read_options,
        lambda: open_result(place, str(place)).read(),
        lambda: read_labels(place),
        lambda: result_reader.read_grid(place),
        lambda: read_tracks(place / "objects.json"),
        lambda: readers.read_truth(place).static_hits(),
        lambda: readers.read_truth(place).walls(),
        lambda: readers.read_truth(place).lasting(),
        lambda: load_truth(place),
    ):
        with suppress(InputError):
            reader()


_recording_files: list[bytes] = []


def _results(work: Path) -> Iterator[bytes]:
    """Seeds of results, which lie in the folder of their recording."""
    _recording_files[:] = parts.split_parts(next(corpus.stillmap(work / "of")))
    yield from corpus.result(work)


TARGETS = {
    "carmen": Target(_file("in.log"), corpus.carmen),
    "stillmap": Target(_folder(corpus.STILLMAP), corpus.stillmap, parts.mutate_parts),
    "bag": Target(_file("in.bag"), corpus_bags.bag1, containers.mutate_bag),
    "mcap": Target(_file("in.mcap"), corpus_bags.mcap, containers.mutate_mcap),
    "db3": Target(_file("in.db3"), corpus_bags.db3, containers.mutate_db3),
    "ros1": Target(
        _messages("ros1"), lambda _: corpus_bags.messages_of("ros1"), parts.mutate_parts
    ),
    "cdr": Target(_messages("cdr"), lambda _: corpus_bags.messages_of("cdr"), parts.mutate_parts),
    "kitti": Target(_folder(corpus.KITTI), corpus.kitti, parts.mutate_parts),
    "drive": Target(_folder(corpus.DRIVE), corpus.drive, parts.mutate_parts),
    "pcd": Target(_file("in.pcd"), corpus.pcd, containers.mutate_pcd),
    "ply": Target(_file("in.ply"), corpus.ply),
    "las": Target(_file("in.las"), corpus.las),
    "e57": Target(_file("in.e57"), corpus.e57, containers.mutate_e57),
    "3dtk": Target(_folder(corpus.THREEDTK), corpus.threedtk, parts.mutate_parts),
    "scenes": Target(_folder(corpus_images.SCENES), corpus_images.scenes, parts.mutate_parts),
    "tum": Target(_folder(corpus_images.TUM), corpus_images.tum, parts.mutate_parts),
    "cameras": Target(_cameras, corpus_images.cameras),
    "toml": Target(_toml, corpus.toml),
    "rows": Target(_rows, corpus.rows),
    "result": Target(_result, _results, parts.mutate_parts),
}
