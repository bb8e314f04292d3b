"""The tasks of a fleet: inspect a recording, map it, merge the results of a place.

A task is a few strings, so that it can be sent to another machine, where `run_task` runs it. The
work is done by `stillmap` itself in a child process. Nothing of a task that was killed counts: its
result appears whole or not at all.
"""

import hashlib
import html
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stillmap.core.errors import InputError
from stillmap.core.files import to_encodable, write_text
from stillmap.core.input_files import read_bytes, read_text
from stillmap.core.json import to_json
from stillmap.core.version import package_version
from stillmap.fleet.artifacts import PLACES, RESULTS, find_result, write_label
from stillmap.fleet.backends import open_storage
from stillmap.fleet.child import Stopped, run_stillmap
from stillmap.fleet.content import fingerprint, hash_content
from stillmap.fleet.outcomes import Outcome, outcome_of, outcome_of_error
from stillmap.fleet.settings import Settings, info_command, map_command, merge_command
from stillmap.fleet.storage import RECORD, Storage
from stillmap.fleet.summary import summarize_result, summarize_sessions
from stillmap.fleet.urls import is_url

_MAX_BYTES = 1 << 30  # of a record or report

Stop = threading.Event | None


@dataclass(frozen=True)
class Inspect:
    """Find out what a recording holds.

    Attributes:
        name: of the recording in the fleet.
        source: its absolute path, or URL.
        fingerprint: see `content.fingerprint`.
        settings: how it is read.
        version: of stillmap on the machine that asks.
    """

    name: str
    source: str
    fingerprint: str
    settings: Settings
    version: str = package_version()

    def run(self, stop: Stop) -> Outcome:
        with _local_source(self.source) as path, ThreadPoolExecutor(1) as pool:
            # both at once: what one of them has read, the other one finds in memory
            hashing = pool.submit(hash_content, path)
            ended = run_stillmap(info_command(path, self.settings), stop)
            content = hashing.result()
            outcome = _with_urls(outcome_of(ended), self.source, path)
        if outcome.status != "done":
            return outcome
        found = {**json.loads(ended.stdout), "digest": content.digest, "bytes": content.size}
        return replace(outcome, found=found)


@dataclass(frozen=True)
class Map:
    """Map a recording into `results/NAME`.

    Attributes:
        name: of the result.
        source, fingerprint: see `Inspect`.
        settings: how it is mapped.
        key: see `artifacts.key_of`.
        root: folder or URL of the fleet.
        version: of stillmap on the machine that asks.
    """

    name: str
    source: str
    fingerprint: str
    settings: Settings
    key: str
    root: str
    version: str = package_version()

    def run(self, stop: Stop) -> Outcome:
        storage, name = open_storage(self.root), f"{RESULTS}/{self.name}"
        if label := find_result(storage, name, self.key):
            return outcome_of_label(label)
        if fingerprint(self.source) != self.fingerprint:
            hint = "give the same command again"
            raise InputError("has changed while the fleet ran", where=self.source, hint=hint)
        with storage.attempt() as work, _local_source(self.source) as path:
            result = work / "result"
            ended = run_stillmap(map_command(path, result, self.settings), stop)
            outcome = _with_urls(outcome_of(ended), self.source, path)
            if outcome.status != "done":
                return outcome
            _replace_in_texts(result, {str(path): self.source})
            return _publish(storage, name, self.key, result, summarize_result(result), outcome)


@dataclass(frozen=True)
class Merge:
    """Merge the results of a place into `places/NAME`.

    Attributes:
        name: of the place.
        results: names of the results.
        sources: paths or URLs of their recordings, in the same order.
        settings, key, root, version: see `Map`.
    """

    name: str
    results: tuple[str, ...]
    sources: tuple[str, ...]
    settings: Settings
    key: str
    root: str
    version: str = package_version()

    def run(self, stop: Stop) -> Outcome:
        storage, name = open_storage(self.root), f"{PLACES}/{self.name}"
        if label := find_result(storage, name, self.key):
            return outcome_of_label(label)
        with storage.attempt() as work, ExitStack() as copies:
            place, texts, folders = work / "result", dict[str, str](), list[Path]()
            for result, source in zip(self.results, self.sources, strict=True):
                folder = storage.local_folder(f"{RESULTS}/{result}", work)
                if is_url(source):
                    path = copies.enter_context(_local_source(source))
                    folder = _point_to_copy(folder, work / "sessions" / result, source, path)
                    texts[str(path)] = source
                texts[str(folder)] = f"{storage.root}/{RESULTS}/{result}"
                folders.append(folder)
            ended = run_stillmap(merge_command(folders, place, self.settings), stop)
            outcome = outcome_of(ended)
            if outcome.status != "done":
                return replace(outcome, why=_replace_all(outcome.why, texts))
            _replace_in_texts(place, texts)
            summary = {**summarize_result(place), "sessions": summarize_sessions(place)}
            return _publish(storage, name, self.key, place, summary, outcome)


Task = Inspect | Map | Merge


def identify(task: Task) -> str:
    """A text that is equal for equal tasks alone."""
    digest = hashlib.sha256(repr(task).encode()).hexdigest()
    return f"{type(task).__name__.lower()}-{task.name}-{digest[:32]}"


def run_task(task: Task, stop: Stop = None) -> Outcome:
    """Run a task on this machine; errors become an outcome.

    Raises:
        Stopped: `stop` was set.
    """
    if task.version != package_version():
        what = f"this worker has stillmap {package_version()}, the caller {task.version}"
        return Outcome("failed", what)
    try:
        return task.run(stop)
    except Stopped:
        raise
    except (InputError, OSError) as error:
        return outcome_of_error(error)
    except Exception as error:  # of one task: the others go on
        return Outcome("failed", f"a defect of stillmap: {error!r}")


def outcome_of_label(label: dict[str, Any]) -> Outcome:
    """The outcome of a task whose result is there."""
    return Outcome(
        "done",
        found=dict(label.get("summary", {})),
        cpu_seconds=float(label.get("cpu_seconds", 0.0)),
        peak_memory_bytes=int(label.get("peak_memory_bytes", 0)),
    )


def _publish(
    storage: Storage, name: str, key: str, folder: Path, summary: dict[str, Any], outcome: Outcome
) -> Outcome:
    """Put a finished result with its label in its place."""
    label = {
        "summary": summary,
        "cpu_seconds": outcome.cpu_seconds,
        "peak_memory_bytes": outcome.peak_memory_bytes,
    }
    # the label fits the record of this result alone: until the result is there, it says nothing
    write_label(storage, name, key, read_bytes(folder / RECORD, _MAX_BYTES), label)
    storage.publish(folder, name)
    return outcome_of_label(label)


@contextmanager
def _local_source(source: str) -> Iterator[Path]:
    """A recording as a local path: a temporary copy of one in a bucket."""
    if not is_url(source):
        yield Path(source)
        return
    from stillmap.fleet.bucket import fetch, local_scratch

    with local_scratch() as scratch:
        yield fetch(source, scratch)


def _with_urls(outcome: Outcome, source: str, path: Path) -> Outcome:
    """The outcome with the URL of a recording instead of the path of its copy."""
    return replace(outcome, why=_replace_all(outcome.why, {str(path): source}))


def _point_to_copy(folder: Path, new: Path, source: str, path: Path) -> Path:
    """A result whose recording is a local copy: links to its files, but for its record."""
    new.mkdir(parents=True)
    for one in folder.iterdir():
        if one.name != RECORD:
            (new / one.name).symlink_to(one)
    text = read_text(folder / RECORD, _MAX_BYTES)
    write_text(new / RECORD, _replace_all(text, {source: str(path)}))
    return new


def _replace_in_texts(folder: Path, texts: dict[str, str]) -> None:
    """Replace paths of copies in the JSON and HTML files of a result."""
    texts = {old: new for old, new in texts.items() if old != new}
    for path in folder.rglob("*") if texts else ():
        if path.suffix in (".json", ".html") and path.is_file():
            text = read_text(path, _MAX_BYTES)
            write_text(path, _replace_all(text, texts))


def _replace_all(text: str, texts: dict[str, str]) -> str:
    """Replace texts, as they are and as JSON and HTML write them; the longest first."""
    for old in sorted(texts, key=len, reverse=True):
        for write in (str, _in_json, html.escape, _in_html):
            text = text.replace(write(old), write(texts[old]))
    return text


def _in_html(text: str) -> str:
    return to_encodable(html.escape(text))


def _in_json(text: str) -> str:
    return to_json(text)[1:-1]
