"""Every writer with every fault of its output: exit status 0 or 2, one line, nothing left over."""

import ctypes
import errno
import importlib.util
import os
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from maps import QUICK

import stillmap
from stillmap.core import files
from stillmap.io import write
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.results.gltf import write_glb

_LIMIT = 4096  # bytes of a file: stands for a full disk, which fails in the same calls
_CAPABILITIES = 0x20080522  # version 3 of capset(2)
_OVERRIDE = 0b110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH: root may write where others may not
NO_UTF8 = os.fsdecode(b"n\xe4me")


class Writer(NamedTuple):
    """A command that writes.

    Attributes:
        words: before `-o`; upper-case names stand for fixtures.
        ending: of its output.
        is_folder: what it writes.
        is_quick: belongs to the tests that always run.
    """

    words: tuple[str, ...]
    ending: str = ""
    is_folder: bool = True
    is_quick: bool = False


def _file(*words: str, is_quick: bool = False) -> Writer:
    *words, ending = words
    return Writer(tuple(words), ending, False, is_quick)


_SMALL = ("--set", "objects.enabled=false", *QUICK)
WRITERS = {
    "map": Writer(("map", "ROOM", *_SMALL), is_quick=True),
    "map-3d": Writer(("map", "SPACE", *QUICK)),
    "merge": Writer(("merge", "ROOM", "RESULT", *_SMALL)),
    "live": Writer(("live", "--replay", "ROOM")),
    "simulate": Writer(("simulate", "hall", "--scans", "9"), is_quick=True),
    "simulate-sessions": Writer(("simulate", "office", "--scans", "9", "--sessions", "2")),
    "convert-folder": Writer(("convert", "ROOM"), is_quick=True),
    "convert-ros2": Writer(("convert", "ROOM", "--to", "ros2")),
    "convert-kitti": Writer(("convert", "SPACE", "--to", "kitti"), is_quick=True),
    "convert-pcd": Writer(("convert", "SPACE", "--to", "pcd")),
    "nav2": Writer(("convert", "RESULT", "--to", "nav2"), is_quick=True),
    "filter-folder": Writer(("filter", "RESULT"), is_quick=True),
    "filter-pcd": Writer(("filter", "SPACE_RESULT", "--to", "pcd")),
    "filter-ros2": Writer(("filter", "RESULT", "--to", "ros2")),
    **{
        f"convert{ending}": _file("convert", "ROOM", ending, is_quick=ending in (".log", ".bag"))
        for ending in (".log", ".clf.gz", ".bag", ".db3", ".mcap", ".ply", ".las", ".laz")
    },
    **{
        f"export{ending}": _file("convert", "RESULT", ending, is_quick=ending == ".parquet")
        for ending in (".parquet", ".mcap", ".bag", ".db3")
    },
    **{
        f"cloud{ending}": _file("convert", "SPACE_RESULT", ending, is_quick=ending == ".pcd")
        for ending in (".ply", ".pcd", ".las", ".laz", ".e57", ".xyz", ".mcap")
    },
    **{f"filter{ending}": _file("filter", "RESULT", ending) for ending in (".log", ".mcap")},
}
_NEEDS = {".las": "laspy", ".laz": "lazrs", ".e57": "pye57"}


@contextmanager
def _full(folder: Path, name: str, _: Writer) -> Iterator[Path]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (_LIMIT, hard))
    try:
        yield folder / name
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def _denied(folder: Path, name: str, _: Writer) -> Iterator[Path]:
    (folder / "closed").mkdir(mode=0o555)
    with _without_override():
        yield folder / "closed" / name


@contextmanager
def _without_override() -> Iterator[None]:
    """Root is a user like others within the block; in this thread and those that it starts."""
    if os.geteuid() != 0:
        yield
        return
    libc = ctypes.CDLL(None, use_errno=True)
    head, sets = (ctypes.c_uint32 * 2)(_CAPABILITIES, 0), (ctypes.c_uint32 * 6)()
    if not hasattr(libc, "capget") or libc.capget(head, sets):
        pytest.skip("root, and capabilities cannot be dropped")
    before = sets[0]
    sets[0] &= ~_OVERRIDE
    assert libc.capset(head, sets) == 0
    try:
        yield
    finally:
        sets[0] = before
        assert libc.capset(head, sets) == 0


@contextmanager
def _vanishing(folder: Path, name: str, _: Writer) -> Iterator[Path]:
    """Its folder goes right before the output is moved there."""
    with pytest.MonkeyPatch.context() as patch:
        for function in ("_publish_folder", "_publish_file"):
            original = getattr(files, function)

            def gone(*words: object, original: Callable[..., None] = original) -> None:
                shutil.rmtree(folder / "there", ignore_errors=True)
                original(*words)

            patch.setattr(files, function, gone)
        (folder / "there").mkdir()
        yield folder / "there" / name


@contextmanager
def _link(folder: Path, name: str, _: Writer) -> Iterator[Path]:
    (folder / "disk").mkdir()
    (folder / name).symlink_to(Path("disk", name))
    yield folder / name
    assert (folder / name).is_symlink()


@contextmanager
def _mount(folder: Path, name: str, writer: Writer) -> Iterator[Path]:
    """As if something was mounted there; tests/cli/test_mounts.py mounts indeed."""
    path = folder / name
    if writer.is_folder:
        path.mkdir()
    else:
        path.write_text("old")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "_is_mount_point", lambda folder: folder == path)
        for function in ("rename", "replace"):
            original = getattr(os, function)

            def busy(source: str, target: str, original: Callable[..., None] = original) -> None:
                if path in (Path(source), Path(target)):
                    raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))
                original(source, target)

            patch.setattr(os, function, busy)
        yield path


@contextmanager
def _at(folder: Path, name: str, _: Writer) -> Iterator[Path]:
    yield folder / name


class Fault(NamedTuple):
    """What is wrong with an output: the setting, its name, and the exit status that must follow."""

    make: Callable[[Path, str, Writer], AbstractContextManager[Path]]
    stem: str = "out"
    statuses: tuple[int, ...] = (0, 2)


FAULTS = {
    "full": Fault(_full, statuses=(2,)),
    "denied": Fault(_denied, statuses=(2,)),
    "vanishes": Fault(_vanishing, statuses=(2,)),
    "link": Fault(_link, statuses=(0,)),
    "mount": Fault(_mount, statuses=(0,)),
    "longest": Fault(_at, "n" * 255, (0,)),
    "too-long": Fault(_at, "n" * 256, (2,)),
    "no-utf8": Fault(_at, NO_UTF8),
}


@pytest.fixture(scope="module")
def inputs(room, mapped, tmp_path_factory) -> dict[str, Path]:
    """What the words of writers stand for."""
    folder = tmp_path_factory.mktemp("inputs")
    rng = np.random.default_rng(1)
    walls = rng.uniform(-4, 4, (4, 400, 3)).astype(np.float32)
    walls[..., 0] = 3.0
    walls[:, ::2] = walls[:, ::2, [1, 0, 2]]
    poses = np.tile(np.eye(4), (4, 1, 1))
    recording = stillmap.Recording.from_clouds(
        1_700_000_000 + 0.1 * np.arange(4), list(walls), odometry=poses
    )
    write(recording, folder / "space")
    result = stillmap.build(folder / "space", options={"em.max_iterations": 1})
    result.save(folder / "space-result")
    triangles = Mesh(
        walls[0, :300].astype(np.float64), np.arange(300, dtype=np.int32).reshape(-1, 3)
    )
    if importlib.util.find_spec("trimesh"):
        write_glb(folder / "space-result" / "mesh.glb", triangles)
    return {
        "ROOM": room,
        "RESULT": mapped,
        "SPACE": folder / "space",
        "SPACE_RESULT": folder / "space-result",
    }


def _cases() -> Iterator[object]:
    for name, writer in WRITERS.items():
        for fault in FAULTS:
            marks = () if writer.is_quick else pytest.mark.slow
            yield pytest.param(writer, FAULTS[fault], id=f"{name}-{fault}", marks=marks)


def _names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


@pytest.mark.parametrize(("writer", "fault"), list(_cases()))
def test_fault(call, inputs, tmp_path, writer, fault):
    if writer.ending in _NEEDS:
        pytest.importorskip(_NEEDS[writer.ending])
    stem = fault.stem[: len(fault.stem) - len(writer.ending)] if len(fault.stem) > 9 else fault.stem
    words = [str(inputs.get(word, word)) for word in writer.words]
    more = ["--overwrite"] if fault.make is _mount else []
    before = {name: _stamps(path) for name, path in inputs.items()}
    with fault.make(tmp_path, stem + writer.ending, writer) as output:
        known = _names(tmp_path)
        done = call(*words, "-o", output, "--quiet", *more)
        assert done.returncode in fault.statuses, done.stderr
        if done.returncode == 0:
            _check_output(output, writer)
        else:
            lines = done.stderr.splitlines()
            assert all(line.startswith("stillmap: ") for line in lines)
            if writer is WRITERS["live"] and fault is FAULTS["full"]:  # says so when it happens
                assert "poses go on" in lines.pop(0)
                assert "loops are no longer closed" in lines.pop(0)
            if writer is WRITERS["live"] and len(lines) > 1:
                assert "the drive is kept" in lines.pop(0)
            assert len(lines) == 1
        left = _names(tmp_path) - known
    assert {name: _stamps(path) for name, path in inputs.items()} == before
    _check_what_is_left(left, done, output)


def _stamps(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*")}


def _check_output(output: Path, writer: Writer) -> None:
    assert output.is_dir() == writer.is_folder
    if writer.is_folder:
        assert any(output.iterdir())
        assert not [one for one in output.iterdir() if one.name.startswith(".")]
    else:
        assert output.stat().st_size > 3


def _check_what_is_left(left: set[str], done: object, output: Path) -> None:
    """The output, and what the message names, a checkpoint."""
    hidden = {name for name in left if name.partition("/")[0].startswith(".")}
    if "--resume" not in done.stderr:
        assert hidden == set()
    assert all(".resume" in name for name in hidden)
    assert not [name for name in left if name.endswith(".part") or name.endswith(".old")]
    if done.returncode == 2:
        others = left - hidden
        assert not others or "drive is kept" in done.stderr, others
    else:
        stem = output.name.removesuffix(output.suffix)
        places = {name.split("/")[0] for name in left - hidden} - {"disk"}
        assert all(name.startswith(stem) for name in places), places
