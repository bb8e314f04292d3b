"""Ctrl-C at any line of what writes an output: it is there, or as it was, and nothing else is."""

import contextlib
import errno
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType

import pytest

from stillmap.cli import arguments, console
from stillmap.core import files
from stillmap.pipeline import checkpoint

_MODULES = (files, arguments, checkpoint)
CALLS_ONLY = {__file__, contextlib.__file__, tempfile.__file__}
# a signal within what they call comes to the same
TRACED = {*CALLS_ONLY, *(module.__file__ for module in _MODULES)}
NUMBERS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
OLD, NEW = {"out": "", "out/mark": "old"}, {"out": "", "out/mark": "new", "out/more": ""}


@pytest.fixture(autouse=True)
def handlers(monkeypatch):
    """The signal handlers of the command."""
    before = {number: signal.getsignal(number) for number in NUMBERS}
    signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored where tests run
    console.handle_signals(is_interrupted.__code__)
    monkeypatch.setattr(console, "send_again", lambda _: None)  # nothing is left to interrupt
    monkeypatch.setattr("os.fsync", lambda _: None)  # which takes most of the time
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def is_interrupted(work: Callable[[], None], step: int) -> bool:
    """Works, and sends Ctrl-C before a line or a call; False if the work has fewer."""
    steps = 0

    def trace(frame: FrameType, event: str, _: object) -> Callable[..., object] | None:
        nonlocal steps
        if frame.f_code.co_filename not in TRACED:
            return None
        # lines at which Python handles no signals: an exception there would not be forgotten
        if event != "call" and (event != "line" or frame.f_code.co_filename in CALLS_ONLY):
            return trace
        steps += 1
        if steps == step + 1:
            signal.raise_signal(signal.SIGINT)
        return trace

    try:
        sys.settrace(trace)
        work()
    except KeyboardInterrupt:
        pass
    finally:
        sys.settrace(None)
    return steps > step


def at_every_step(work: Callable[[Path], None], folder: Path, before: dict[str, str]) -> set[str]:
    """What is left of work that is interrupted."""
    seen, step = set(), 0
    while True:
        home = folder / str(step)
        home.mkdir()
        put(home, before)
        if not is_interrupted(partial(work, home / "out"), step):
            assert sys.exc_info() == (None, None, None)
            return seen
        seen.add(str(state(home)))
        step += 1


def put(folder: Path, content: dict[str, str]) -> None:
    for name, text in content.items():
        (folder / name).write_text(text) if text else (folder / name).mkdir()


def state(folder: Path) -> dict[str, str]:
    paths = sorted(folder.rglob("*"))
    return {str(one.relative_to(folder)): one.read_text() if one.is_file() else "" for one in paths}


def write_folder(path: Path) -> None:
    with files.atomic_folder(path, "mark", overwrite=True) as work:
        put(work, {"mark": "new", "more": ""})


def write_file(path: Path) -> None:
    with files.atomic_file(path) as work:
        work.write_text("new")


@pytest.mark.parametrize("before", [{}, OLD], ids=["new", "replaced"])
def test_folders(tmp_path, before):
    assert at_every_step(write_folder, tmp_path, before) == {str(before), str(NEW)}


@pytest.mark.parametrize("before", [{}, {"out": "old"}], ids=["new", "replaced"])
def test_files(tmp_path, before):
    assert at_every_step(write_file, tmp_path, before) == {str(before), str({"out": "new"})}


@pytest.mark.parametrize("number", [errno.EBUSY, errno.EXDEV])
@pytest.mark.parametrize("before", [{}, OLD], ids=["new", "replaced"])
def test_folders_that_cannot_be_renamed(tmp_path, monkeypatch, before, number):
    rename = os.rename

    def refuse(source, target):
        if "out" in (Path(source).name, Path(target).name):
            raise OSError(number, os.strerror(number))
        rename(source, target)

    monkeypatch.setattr("os.rename", refuse)
    assert at_every_step(write_folder, tmp_path, before) == {str(before), str(NEW)}


def test_exchanges_in_place(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_is_mount_point", lambda folder: folder.name == "out")
    assert at_every_step(write_folder, tmp_path, OLD) == {str(OLD), str(NEW)}


@contextlib.contextmanager
def all_at_once(path):
    """What is removed at the end, whatever happens."""
    with (
        files.temporary_folder(path / "out") as work,
        checkpoint.lock_checkpoints(path / "made/out"),
        tempfile.TemporaryDirectory(dir=path),
    ):
        (work / "more").mkdir()
        yield


def leave(path):
    with all_at_once(path.parent):
        pass


def fail(path):
    with contextlib.suppress(ZeroDivisionError), all_at_once(path.parent):
        raise ZeroDivisionError


def stop(path):
    """What was interrupted once before."""
    with all_at_once(path.parent):
        raise KeyboardInterrupt


@pytest.mark.filterwarnings("ignore:Implicitly cleaning up:ResourceWarning")
@pytest.mark.parametrize("work", [leave, fail, stop])
def test_clean_up(tmp_path, work):
    assert at_every_step(work, tmp_path, {}) == {"{}"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_foreign_handlers(tmp_path, monkeypatch, error):
    """As in notebooks: the exception comes in the middle of the removal."""
    rmtree, calls = shutil.rmtree, []

    def interrupted(path, **options):
        calls.append(path)
        if len(calls) == 1:
            raise error
        rmtree(path, **options)

    monkeypatch.setattr("shutil.rmtree", interrupted)
    with pytest.raises(error), files.temporary_folder(tmp_path / "out"):
        pass
    assert list(tmp_path.iterdir()) == []
