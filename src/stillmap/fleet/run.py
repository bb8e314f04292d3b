"""A fleet from its inputs to its page: find the recordings, map, merge, write."""

import hashlib
import logging
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from stillmap.core.errors import InputError, explaining_refusal, import_extra
from stillmap.core.files import atomic_file, package_version, resolve_output, to_encodable
from stillmap.core.input_files import hold_lock
from stillmap.core.json import to_json
from stillmap.core.profiling import Show
from stillmap.fleet import inputs
from stillmap.fleet.tasks import PLACES, RESULTS, STAGING, Outcome, Task, read_made, run_task
from stillmap.results.report import template

LIST, PAGE = "fleet.json", "fleet.html"
_LOCK = ".lock"
# Ctrl-C at a terminal reaches all processes: the client alone ends its workers
_PRELOAD = ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"]
_TIMEOUT = 15  # s for the scheduler to answer


_FACTS = ("scans", "beams", "duration_s")  # in `fleet.json`


class Request(NamedTuple):
    """The job of a fleet.

    Attributes:
        entries: recordings, folders and patterns of them, with their places.
        output: folder or URL of the fleet.
        command: runs a command line of stillmap on a worker; a function of a module.
        map_flags, merge_flags: flags of `map` and `merge`.
        jobs: local processes at once.
        scheduler: address of a Dask scheduler; empty: local processes.
        fail: takes a line about a recording or a place that failed.
        progress: takes what is done, and how many of how many have ended.
    """

    entries: Sequence[inputs.Entry]
    output: str
    command: Callable[[list[str]], None]
    fail: Callable[[str], None]
    progress: Show
    map_flags: tuple[str, ...] = ()
    merge_flags: tuple[str, ...] = ()
    jobs: int = 1
    scheduler: str = ""


class Job(NamedTuple):
    """A recording, and how mapping it ended."""

    source: inputs.Source
    outcome: Outcome


class Place(NamedTuple):
    """A place, its recordings, and how merging their results ended."""

    name: str
    jobs: list[Job]
    outcome: Outcome


class Fleet(NamedTuple):
    """Result of a fleet."""

    jobs: list[Job]
    places: list[Place]

    @property
    def failed(self) -> int:
        """How many recordings and places failed."""
        outcomes = [job.outcome for job in self.jobs] + [place.outcome for place in self.places]
        return sum(outcome.status not in ("done", "too few") for outcome in outcomes)

    def to_list(self) -> list[dict[str, Any]]:
        """The content of `fleet.json`: an entry for each recording."""
        places = {place.name: place for place in self.places}
        return [_describe(job, places.get(job.source.place or "")) for job in self.jobs]


def _describe(job: Job, place: Place | None) -> dict[str, Any]:
    source, outcome = job.source, job.outcome
    merged = place is not None and place.outcome.is_done
    return {
        **source._asdict(),
        "status": outcome.status,
        "why": outcome.why,
        "result": f"{RESULTS}/{source.name}" if outcome.is_done else None,
        "cpu_seconds": round(outcome.cpu_seconds, 3),
        "peak_memory_bytes": outcome.peak_memory_bytes,
        **{name: outcome.summary.get(name) for name in _FACTS},
        "place_result": f"{PLACES}/{source.place}" if merged else None,
        "place_why": "" if place is None or merged else place.outcome.why,
    }


def run_fleet(request: Request) -> Fleet:
    """Map every recording, merge each place, and write `fleet.json` and `fleet.html`.

    Raises:
        InputError: the output is taken, in use or cannot be written, an input holds no recording,
            the storage refuses, a disk is full, no scheduler answers. What was finished stays, and
            the same request goes on from there.
        KeyboardInterrupt: likewise.
    """
    root = inputs.absolute(request.output)
    if inputs.is_local(request.output):
        root = str(resolve_output(Path(root)))
    _require_fleet(root)
    places_of = inputs.find_sources(request.entries)
    with _hold_output(root):
        sources = inputs.name_sources(places_of, _known_names(root))
        with _remove_unfinished(root, request), _open_client(request) as client:
            tasks = [
                Task("map", source.name, (source.input,), root, request.map_flags)
                for source in sources
            ]
            mapped = _run_tasks(client, tasks, request)
            jobs = [Job(source, mapped[source.name]) for source in sources]
            places = _merge_places(client, jobs, root, request)
        fleet = Fleet(jobs, places)
        _write(root, LIST, to_json(fleet.to_list(), indent=2) + "\n")
        _write(root, PAGE, to_encodable(render_page(fleet)))
    return fleet


def _require_fleet(root: str) -> None:
    """Refuse an output that holds other things than a fleet."""
    fs, path = inputs.open_location(root)
    with inputs.explain(root, "read"):
        if not fs.exists(path):
            return
        if not fs.isdir(path):
            raise InputError("is in the way: not a folder", where=root)
        names = {str(entry).rstrip("/").rpartition("/")[2] for entry in fs.ls(path, detail=False)}
    if names - {RESULTS, PLACES, LIST, PAGE, _LOCK, path.rpartition("/")[2]}:
        hint = "choose another; a fleet's own folder is continued"
        raise InputError("already holds something", where=root, hint=hint)


@contextmanager
def _hold_output(root: str) -> Iterator[None]:
    """Keep other fleets out of a folder while the block runs; a URL has no locks.

    Raises:
        InputError: another fleet is writing there, or nothing can be written.
    """
    fs, path = inputs.open_location(root)
    if not inputs.is_local(root):
        _write(root, _LOCK, "")
        with inputs.explain(root, "written"):
            fs.rm_file(f"{path}/{_LOCK}")
        yield
        return
    lock = Path(path, _LOCK)
    with explaining_refusal(root):
        file = hold_lock(lock, "another fleet is writing there", root)
    with file:
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def _known_names(root: str) -> dict[str, str]:
    """The names of the results that are there, by input."""
    fs, path = inputs.open_location(root)
    folder = f"{path}/{RESULTS}"
    with inputs.explain(root, "read"):
        paths = fs.ls(folder, detail=False) if fs.isdir(folder) else []
    names = [str(path).rstrip("/").rpartition("/")[2] for path in paths]
    known = {
        name: read_made(root, f"{RESULTS}/{name}") for name in names if inputs.is_folder_name(name)
    }
    return {made.input: name for name, made in known.items() if made is not None}


@contextmanager
def _remove_unfinished(root: str, request: Request) -> Iterator[None]:
    """Remove what killed workers left, at the end of the block."""
    ended = not request.scheduler  # an interruption does not end the tasks of a scheduler
    try:
        yield
        ended = True
    finally:
        folder = Path(inputs.open_location(root)[1])
        for path in folder.glob(f"*/{STAGING}*") if ended and inputs.is_local(root) else ():
            shutil.rmtree(path, ignore_errors=True)


@contextmanager
def _open_client(request: Request) -> Iterator[Any]:
    """A client of the given scheduler, or of worker processes of this machine."""
    dask = import_extra("distributed", "stillmap fleet", "run", group="fleet")
    for name in ("distributed", "distributed.client", "tornado", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # outcomes say what they report
    if not request.scheduler:
        import_extra("cryptography", "stillmap fleet", "run", group="fleet")  # for its TLS
        with (
            dask.LocalCluster(
                n_workers=request.jobs,
                threads_per_worker=1,
                memory_limit=None,
                dashboard_address="127.0.0.1:0",
                security=True,
                silence_logs=logging.CRITICAL,
                preload=_PRELOAD,
            ) as cluster,
            dask.Client(cluster, set_as_default=False) as client,
        ):
            yield client
        return
    try:
        client = dask.Client(request.scheduler, timeout=_TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        what, hint = f"no Dask scheduler answers: {error}", "as in tcp://HOST:8786"
        raise InputError(what, where=request.scheduler, hint=hint) from error
    with client:
        if not client.nthreads():
            hint = f"start some: dask worker {request.scheduler}"
            raise InputError("this scheduler has no worker", where=request.scheduler, hint=hint)
        _require_version(client, request.scheduler)
        yield client


def _require_version(client: Any, address: str) -> None:
    hint = "install this version, and what else the client has, on all of them"
    try:
        versions = set(client.run(package_version).values())
    except Exception as error:
        what = f"a worker does not know stillmap: {error}"
        raise InputError(what, where=address, hint=hint) from error
    if versions != {package_version()}:
        what = f"the workers have stillmap {', '.join(sorted(versions))}, not {package_version()}"
        raise InputError(what, where=address, hint=hint)


def _run_tasks(client: Any, tasks: Sequence[Task], request: Request) -> dict[str, Outcome]:
    """Run tasks, never more at once than there are threads: a worker that dies takes no other with
    it. Dask runs its task again, as often as `distributed.scheduler.allowed-failures` says.
    """
    dask = import_extra("distributed", "stillmap fleet", "run", group="fleet")
    waiting, running = deque(tasks), dict[Any, Task]()
    ended, outcomes = dask.as_completed(loop=client.loop), dict[str, Outcome]()
    while waiting or running:
        while waiting and len(running) < max(1, sum(client.nthreads().values())):
            task = waiting.popleft()
            key = f"{task.command}-{hashlib.sha256(repr(task).encode()).hexdigest()}"
            future = client.submit(run_task, task, request.command, key=key)
            running[future] = task
            ended.add(future)
        future = next(ended)
        task = running.pop(future)
        outcome = outcomes[task.name] = _outcome(future, client, request)
        if outcome.status == "full":
            hint = "make room, then continue with the same command"
            raise InputError(f"cannot continue: {outcome.why}", where=task.name, hint=hint)
        if not outcome.is_done:
            request.fail(f"{'place ' * (task.command == 'merge')}{task.name}: {outcome.why}")
        what = "mapping" if task.command == "map" else "merging"
        request.progress(what, len(outcomes), len(tasks))
    return outcomes


def _outcome(future: Any, client: Any, request: Request) -> Outcome:
    """The outcome of a task.

    Raises:
        InputError: the scheduler is gone.
    """
    dask = import_extra("distributed", "stillmap fleet", "run", group="fleet")
    try:
        outcome: Outcome = future.result()
        return outcome
    except dask.KilledWorker as error:
        attempts = error.allowed_failures + 1
        return Outcome("failed", f"its worker died {attempts} times: is there enough memory?")
    except (Exception, dask.CancelledError) as error:
        if client.status != "running" or future.cancelled():
            hint = "start it, then continue with the same command"
            what = "the Dask scheduler is gone"
            raise InputError(what, where=request.scheduler, hint=hint) from error
        return Outcome("failed", f"its worker could not run it: {error}")


def _merge_places(client: Any, jobs: Sequence[Job], root: str, request: Request) -> list[Place]:
    """Merge the results of every place that has two of them."""
    members: dict[str, list[Job]] = {}
    for job in jobs:
        if job.source.place is not None:
            members.setdefault(job.source.place, []).append(job)
    tasks, outcomes = [], dict[str, Outcome]()
    for name, of_place in members.items():
        done = [job for job in of_place if job.outcome.is_done]
        if len(done) < 2:
            why = f"merging takes two maps, this place has {len(done) or 'none'}"
            outcomes[name] = Outcome("too few", why)
            continue
        sources = tuple(job.source.input for job in done)
        results = tuple(job.source.name for job in done)
        keys = tuple(job.outcome.key for job in done)
        tasks.append(Task("merge", name, sources, root, request.merge_flags, results, keys))
    outcomes |= _run_tasks(client, tasks, request)
    return [Place(name, of_place, outcomes[name]) for name, of_place in members.items()]


def _write(root: str, name: str, text: str) -> None:
    """Write a file of the fleet, whole or not at all."""
    fs, path = inputs.open_location(root)
    if inputs.is_local(root):
        with atomic_file(Path(path, name)) as work:
            work.write_text(text, encoding="utf-8")
        return
    with inputs.explain(f"{root}/{name}", "written"):
        fs.pipe_file(f"{path}/{name}", text.encode())


def render_page(fleet: Fleet) -> str:
    """`fleet.html`: no outside request, no script; links lead to the reports beside it."""
    return template.render_page({"fleet": fleet}, "fleet.html.j2")
