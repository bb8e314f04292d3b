"""The tasks of a fleet, which Dask's workers run: map a recording, merge the results of a place.

A result is made in a hidden folder beside its place (locally) or in a temporary one (for a URL) and
then takes its place; `made.json` in it says what it was made from. It is made again only where that
differs.
"""

import errno
import hashlib
import html
import json
import logging
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import msgspec
import numpy as np

from stillmap.core.errors import InputError, split_advice
from stillmap.core.files import package_version, write_text
from stillmap.core.input_files import read_text
from stillmap.core.json import to_json
from stillmap.core.profiling import peak_memory_bytes, reset_peak_memory
from stillmap.fleet.inputs import explain, fetch, hash_content, is_local, open_location
from stillmap.results.reader import read_grid, read_run
from stillmap.results.report.figures import data_uri, draw_map, map_window

RESULTS, PLACES = "results", "places"  # folders of the fleet
MADE = "made.json"  # of each result of a fleet
STAGING = ".part-"  # begins the names of unfinished results
_MAX_BYTES = 1 << 30  # of a record or report
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PIXELS, _GREYS = 90_000, 16  # of the small map of the page, at most


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task.

    Attributes:
        status: `done`, `failed`, `full`: a disk is, and no task can go on; or `too few` results
            to be merged.
        why: one line; empty where it is done.
        key: of what the result was made from.
        input: its recording, or the first of them.
        cpu_seconds: of its worker meanwhile.
        peak_memory_bytes: of its worker.
        summary: of the result, JSON-able.
    """

    status: Literal["done", "failed", "full", "too few"]
    why: str = ""
    key: str = ""
    input: str = ""
    cpu_seconds: float = 0.0
    peak_memory_bytes: int = 0
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def is_done(self) -> bool:
        """Whether the result is there."""
        return self.status == "done"


@dataclass(frozen=True)
class Task:
    """Make `results/NAME` or `places/NAME`.

    Attributes:
        command: what is run.
        name: of the result or place.
        sources: absolute paths or URLs of the recordings.
        results: names of the results that are merged, in the order of `sources`.
        content: their keys.
        flags: of the command.
        root: folder or URL of the fleet.
    """

    command: Literal["map", "merge"]
    name: str
    sources: tuple[str, ...]
    root: str
    flags: tuple[str, ...] = ()
    results: tuple[str, ...] = ()
    content: tuple[str, ...] = ()

    @property
    def folder(self) -> str:
        """The result, relative to the fleet."""
        return f"{RESULTS if self.command == 'map' else PLACES}/{self.name}"


def run_task(task: Task, command: Callable[[list[str]], None]) -> Outcome:
    """Make a result unless it is there; errors become an outcome.

    Args:
        task: what is made.
        command: runs a command line of stillmap in this process.
    """
    logging.getLogger().addHandler(logging.NullHandler())  # `run.json` has what is to be said
    try:
        return _make(task, command)
    except Exception as error:  # of one task: the others go on
        why = str(error) if isinstance(error, InputError) else f"a defect of stillmap: {error!r}"
        if isinstance(error, OSError):
            why = f"{error.filename or 'the result'}: {error.strerror or error}"
        return Outcome("full" if _is_disk_full(error) else "failed", why)


def _is_disk_full(error: BaseException | None) -> bool:
    """True if an error, or what it comes from, is that of a full disk."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK_FULL:
            return True
        error = error.__cause__
    return False


def _make(task: Task, command: Callable[[list[str]], None]) -> Outcome:
    if task.command == "map":
        content = hash_content(task.sources[0])
    else:
        content = repr(list(zip(task.results, task.content, strict=True)))
    flags = [flag for flag in task.flags if not flag.startswith("--set=threads=")]
    text = json.dumps([task.command, content, flags, package_version()])
    key = hashlib.sha256(text.encode()).hexdigest()
    known = read_made(task.root, task.folder)
    if known is not None and known.key == key:
        return known
    parent = None
    if is_local(task.root):
        parent = Path(open_location(task.root)[1], task.folder).parent
        parent.mkdir(parents=True, exist_ok=True)
    reset_peak_memory()
    started = time.process_time()
    with TemporaryDirectory(prefix=f"{STAGING}{task.name}-", dir=parent) as scratch:
        inputs, texts = _prepare(task, Path(scratch))
        result = Path(scratch, task.name)
        try:
            command([task.command, *map(str, inputs), "-o", str(result), "--quiet", *task.flags])
        except InputError as error:
            raise InputError(_replace(str(error), texts)) from error
        _replace_in_files(result, texts)
        cost = time.process_time() - started, peak_memory_bytes()
        outcome = Outcome("done", "", key, task.sources[0], *cost, _summarize(result))
        write_text(result / MADE, to_json(asdict(outcome)))
        _publish(result, task)
    return outcome


def read_made(root: str, folder: str) -> Outcome | None:
    """The outcome of the task that made the result in a folder; None: there is no whole one."""
    fs, path = open_location(root)
    with explain(f"{root}/{folder}", "read"):
        try:
            return msgspec.json.decode(fs.cat_file(f"{path}/{folder}/{MADE}"), type=Outcome)
        except (FileNotFoundError, NotADirectoryError, msgspec.DecodeError):
            return None


def _prepare(task: Task, scratch: Path) -> tuple[list[Path], dict[str, str]]:
    """The inputs of the command as local paths, and which folders stand for which URLs."""
    copies, texts = list[Path](), dict[str, str]()
    for number, source in enumerate(task.sources):
        copies.append(_local(source, folder := scratch / f"input-{number}"))
        texts[str(folder)] = source.rpartition("/")[0]
    if task.command == "map":
        return copies, texts
    results, folder = list[Path](), scratch / RESULTS
    for name, source, copy in zip(task.results, task.sources, copies, strict=True):
        path = _local(f"{task.root}/{RESULTS}/{name}", folder)
        if not is_local(source):  # merging reads the recording of a result again
            if is_local(task.root):
                path = Path(shutil.copytree(path, folder / name))
            _replace_in_files(path, {source: str(copy)})
        results.append(path)
    return results, {**texts, str(folder): f"{task.root}/{RESULTS}"}


def _local(url: str, folder: Path) -> Path:
    """A path as it is, a URL as a copy in a folder."""
    return Path(open_location(url)[1]) if is_local(url) else fetch(url, folder)


def _publish(result: Path, task: Task) -> None:
    """Put a whole result in its place; at a URL `made.json` goes first and comes last."""
    fs, root = open_location(task.root)
    target = f"{root}/{task.folder}"
    if is_local(task.root):
        old = result.with_name("old")
        if os.path.lexists(target):
            os.rename(target, old)
        os.rename(result, target)
        return
    with explain(f"{task.root}/{task.folder}", "written"):
        if fs.exists(f"{target}/{MADE}"):
            fs.rm_file(f"{target}/{MADE}")
        if fs.exists(target):
            fs.rm(target, recursive=True)
        paths = [path for path in sorted(result.rglob("*")) if path.is_file()]
        for path in sorted(paths, key=lambda path: path == result / MADE):
            name = f"{target}/{path.relative_to(result).as_posix()}"
            fs.makedirs(name.rpartition("/")[0], exist_ok=True)
            fs.put_file(str(path), name)


def _replace_in_files(folder: Path, texts: dict[str, str]) -> None:
    """Replace paths, which need no escapes, in the JSON and HTML files of a result."""
    for path in folder.rglob("*"):
        if path.suffix in (".json", ".html") and path.is_file():
            is_html, text = path.suffix == ".html", read_text(path, _MAX_BYTES)
            escaped = {k: html.escape(v) if is_html else to_json(v)[1:-1] for k, v in texts.items()}
            replaced = _replace(text, escaped)
            if replaced != text:
                write_text(path, replaced)


def _replace(text: str, texts: dict[str, str]) -> str:
    for old, new in texts.items():
        text = text.replace(old, new)
    return text


def _summarize(folder: Path) -> dict[str, Any]:
    """The JSON-able summary of a result: a small map, figures, warnings, sessions."""
    record = read_run(folder)
    warnings = [split_advice(text) for text in record.get("warnings", ())]
    stamps, grid = np.load(folder / "beams/stamp_ns.npy", mmap_mode="r"), read_grid(folder)
    picture = None
    if grid.p_occupied.size:
        drawn = draw_map(grid, map_window([grid]), _PIXELS).convert("L")
        picture = data_uri(drawn.quantize(_GREYS), optimize=True)
    sessions = folder / "sessions.json"
    listed = json.loads(read_text(sessions, _MAX_BYTES)) if sessions.is_file() else []
    return {
        "scans": record.get("counts", {}).get("scans"),
        "beams": record.get("counts", {}).get("beams"),
        "duration_s": float(stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0,
        "area": record.get("area", {}),
        "quality": record.get("quality", {}),
        "changes": len(record.get("changes", ())),
        "warnings": [what for what, todo in warnings if todo],
        "notes": [what for what, todo in warnings if not todo],
        "map": picture,
        "sessions": [
            {key: session.get(key) for key in ("name", "accepted", "why")} for session in listed
        ],
    }
