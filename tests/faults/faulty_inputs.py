"""What stillmap reads: small inputs of every kind, and the file of each that is at fault.

Recordings are the seeds of fuzzing.
"""

import gzip
import sys
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

TESTS = Path(__file__).resolve().parent.parent
sys.path.append(str(TESTS / "fuzz"))

import containers  # noqa: E402
import corpus  # noqa: E402
import corpus_bags  # noqa: E402
import corpus_images  # noqa: E402
import parts  # noqa: E402

Make = Callable[[Path], Path]
Command = Callable[[Path, Path], list[str]]  # of the input and a new output


class Reader(NamedTuple):
    """A reader that is put to the test.

    Attributes:
        name: of the test.
        make: makes the input in an empty folder, and gives its path.
        victim: the file in that folder which is at fault.
        command: reads the input.
        is_quick: whether every `make test` runs it.
    """

    name: str
    make: Make
    victim: str
    command: Command
    is_quick: bool = False


def info(path: Path, output: Path) -> list[str]:  # noqa: ARG001
    return ["info", str(path)]


def convert(path: Path, output: Path) -> list[str]:
    return ["convert", str(path), "-o", str(output), "--to", "stillmap", "--quiet"]


def _workplace(folder: Path) -> Path:
    """A new folder beside another one, in which its seeds are made."""
    work = folder.with_name(f"{folder.name}-made")
    work.mkdir()
    return work


def _seed(folder: Path, seeds: Callable[[Path], Iterator[bytes]], number: int = 0) -> bytes:
    """The seed of that number, made beside a folder."""
    return next(islice(seeds(_workplace(folder)), number, None))


def _file(name: str, seeds: Callable[[Path], Iterator[bytes]], number: int = 0) -> Make:
    """A recording in one file: the seed of that number."""

    def make(folder: Path) -> Path:
        (folder / name).write_bytes(_seed(folder, seeds, number))
        return folder / name

    return make


def _folder(
    names: tuple[str, ...], seeds: Callable[[Path], Iterator[bytes]], number: int = 0
) -> Make:
    """A recording in several files."""

    def make(folder: Path) -> Path:
        content_of = parts.split_parts(_seed(folder, seeds, number))
        for name, content in zip(names, content_of, strict=True):
            if content:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(content)
        return folder

    return make


def _ros2_folder(folder: Path) -> Path:
    (folder / "a_0.mcap").write_bytes(_seed(folder, corpus_bags.mcap))
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths: [a_0.mcap]\n"
    )
    return folder


def _clouds(folder: Path) -> Path:
    for number, content in enumerate(corpus.pcd(_workplace(folder))):
        (folder / f"{number}.pcd").write_bytes(content)
    return folder


def _gzip_log(folder: Path) -> Path:
    path = _file("a.log", corpus.carmen)(folder)
    (folder / "a.log.gz").write_bytes(gzip.compress(path.read_bytes()))
    return folder / "a.log.gz"


def _in_folder(folder: Path) -> Path:
    """A planar recording folder, with files of options and poses beside it."""
    inner = folder / "in"
    inner.mkdir()
    _folder(corpus.STILLMAP, corpus.stillmap)(inner)
    (folder / "options.toml").write_text("[em]\nmax_iterations = 1\n")
    stamps = np.load(inner / "stamp_ns.npy")
    poses = (f"{s // 10**9}.{s % 10**9:09d} 0 0 0 0 0 0 1\n" for s in stamps.tolist())
    (folder / "poses.tum").write_text("".join(poses))
    return inner


def _with_options(path: Path, output: Path) -> list[str]:
    home = path.parent
    options = ["--config", str(home / "options.toml"), "--poses", str(home / "poses.tum")]
    return ["map", str(path), "-o", str(output), "--quiet", "--threads", "1", *options]


def _with_cameras(folder: Path) -> Path:
    inner = folder / "in"
    inner.mkdir()
    _folder(corpus_images.SCENES, corpus_images.scenes)(inner)
    first, _ = corpus_images.cameras(folder)
    (folder / "cameras.toml").write_bytes(first)
    return inner


def _info_with_cameras(path: Path, output: Path) -> list[str]:  # noqa: ARG001
    return ["info", str(path), "--cameras", str(path.parent / "cameras.toml")]


def _recordings() -> Iterator[Reader]:
    for name, file, seeds, number in (
        ("carmen", "a.log", corpus.carmen, 0),
        ("bag", "a.bag", corpus_bags.bag1, 0),
        ("mcap", "a.mcap", corpus_bags.mcap, 0),
        ("db3", "a.db3", corpus_bags.db3, 0),
        ("pcd", "a.pcd", corpus.pcd, 0),
        ("pcd-lzf", "a.pcd", corpus.pcd, 1),
        ("pcd-text", "a.pcd", corpus.pcd, 2),
        ("ply", "a.ply", corpus.ply, 0),
        ("las", "a.las", corpus.las, 0),
        ("laz", "a.laz", corpus.las, 1),
        ("e57", "a.e57", corpus.e57, 0),
    ):
        yield Reader(name, _file(file, seeds, number), file, info, is_quick=True)
    yield Reader("carmen-gzip", _gzip_log, "a.log.gz", info, is_quick=True)
    yield Reader("ros2-folder", _ros2_folder, "a_0.mcap", info)
    yield Reader("ros2-metadata", _ros2_folder, "metadata.yaml", info)
    yield Reader("pcd-folder", _clouds, "1.pcd", info, is_quick=True)
    for name, names, seeds, victims in (
        ("kitti", corpus.KITTI, corpus.kitti, ("velodyne/000001.bin", *corpus.KITTI[:3])),
        ("drive", corpus.DRIVE, corpus.drive, (*corpus.DRIVE[:6], "velodyne_points/data/0.bin")),
        ("3dtk", corpus.THREEDTK, corpus.threedtk, corpus.THREEDTK),
        ("scenes", corpus_images.SCENES, corpus_images.scenes, corpus_images.SCENES[:3]),
        ("scenes", corpus_images.SCENES, corpus_images.scenes, corpus_images.SCENES[-1:]),
        ("tum", corpus_images.TUM, corpus_images.tum, corpus_images.TUM[:4]),
    ):
        for number, victim in enumerate(victims):
            make = _folder(names, seeds)
            yield Reader(f"{name}-{victim}", make, victim, convert, is_quick=not number)
    for victim in corpus.STILLMAP[:-1]:
        make = _folder(corpus.STILLMAP, corpus.stillmap, 1)
        is_quick = victim in ("recording.json", "points.npy")
        yield Reader(f"stillmap-{victim}", make, victim, convert, is_quick)


def _files_beside() -> Iterator[Reader]:
    for victim in ("options.toml", "poses.tum"):
        yield Reader(victim, _in_folder, victim, _with_options, is_quick=True)
    yield Reader("cameras.toml", _with_cameras, "cameras.toml", _info_with_cameras)


RECORDINGS = (*_recordings(), *_files_beside())


def fetching_e57(folder: Path) -> Path:
    """An E57 file that names a schema which the XML library would fetch."""
    (folder / "made").mkdir()
    attributes = (
        b' xmlns:i="http://www.w3.org/2001/XMLSchema-instance" i:schemaLocation="'
        b'http://www.astm.org/COMMIT/E57/2010-e57-v1.0 http://127.0.0.1:9/a.xsd"'
    )
    content = containers.change_e57_xml(
        next(corpus.e57(folder / "made")),
        lambda xml: xml.replace(b"<e57Root", b"<e57Root" + attributes, 1),
    )
    (folder / "fetching.e57").write_bytes(content)
    return folder / "fetching.e57"
