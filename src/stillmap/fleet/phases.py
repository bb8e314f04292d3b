"""The phases of a fleet: inspect, plan, map, merge."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from stillmap.core.errors import InputError
from stillmap.core.version import package_version
from stillmap.fleet.artifacts import PLACES, RESULTS, find_result, key_of
from stillmap.fleet.content import fingerprint
from stillmap.fleet.jobs import Job, Place, Reporter, Request
from stillmap.fleet.journal import Journal
from stillmap.fleet.local_executor import Executor
from stillmap.fleet.memory import estimate_memory, fitting_jobs, machine_memory
from stillmap.fleet.outcomes import MAKE_ROOM, Outcome, outcome_of_error
from stillmap.fleet.storage import Storage
from stillmap.fleet.tasks import Inspect, Map, Merge, Task, outcome_of_label

_RETRIES = 3  # of a task that was killed, or lost its bucket
_GIGABYTE = 1e9


def inspect(
    jobs: Sequence[Job], request: Request, executor: Executor, journal: Journal, report: Reporter
) -> None:
    """Find out what every recording holds, and the key of its result.

    What the journal knows of an unchanged recording is not found out again.
    """
    known, settings = _known_recordings(journal), request.settings.for_reading()
    tasks: dict[str, Inspect] = {}
    for job in jobs:
        try:
            job.fingerprint = fingerprint(job.source.input)
        except (InputError, OSError) as error:
            job.outcome = outcome_of_error(error)
            _fail(job.source.name, job.outcome, journal, report)
            continue
        task = Inspect(job.source.name, job.source.input, job.fingerprint, settings)
        job.info = known.get(_identify(task), {})
        if not job.info:
            tasks[job.source.name] = task
    by_name = {job.source.name: job for job in jobs}
    for ended, outcome in _run_all(list(tasks.values()), executor, "inspecting", journal, report):
        job = by_name[ended.name]
        if outcome.status == "done":
            job.info = {**_main_facts(outcome.found), "inspect_cpu_seconds": outcome.cpu_seconds}
            journal.note("inspected", task=_identify(tasks[ended.name]), info=job.info)
        else:
            job.outcome = outcome
    for job in jobs:
        if job.info:
            job.key = key_of("map", [job.info["digest"]], request.settings)


def plan(
    jobs: Sequence[Job], request: Request, executor: Executor, storage: Storage, report: Reporter
) -> list[Job]:
    """Say what is to be mapped and how much memory it takes; let fewer run at once if need be.

    Returns:
        The recordings that are to be mapped; the others are done or have failed.
    """
    for job in jobs:
        label = find_result(storage, f"{RESULTS}/{job.source.name}", job.key) if job.key else None
        if label is not None:
            job.outcome = outcome_of_label(label)
    waiting = [job for job in jobs if job.outcome is None]
    done, hours = sum(job.is_done for job in jobs), sum(job.duration for job in waiting) / 3600
    bad = len(jobs) - len(waiting) - done
    report.say(
        f"{len(jobs)} recording{'s' * (len(jobs) != 1)}: {len(waiting)} to map ({hours:.2g} h), "
        f"{done} mapped already, {bad} cannot be read"
    )
    if waiting:
        _limit_memory(waiting, request, executor, report)
    return waiting


def map_recordings(
    waiting: Sequence[Job],
    request: Request,
    storage: Storage,
    executor: Executor,
    journal: Journal,
    report: Reporter,
) -> None:
    """Map the recordings that wait, the longest first."""
    by_name = {job.source.name: job for job in waiting}
    ordered = sorted(waiting, key=lambda job: -int(job.info["beams"]))
    tasks = [
        Map(
            job.source.name,
            job.source.input,
            job.fingerprint,
            request.settings,
            job.key,
            storage.root,
        )
        for job in ordered
    ]
    for task, outcome in _run_all(tasks, executor, "mapping", journal, report):
        by_name[task.name].outcome = outcome


def merge_places(
    jobs: Sequence[Job],
    request: Request,
    storage: Storage,
    executor: Executor,
    journal: Journal,
    report: Reporter,
) -> list[Place]:
    """Merge the results of every place that has two of them."""
    members: dict[str, list[Job]] = {}
    for job in jobs:
        if job.source.place is not None:
            members.setdefault(job.source.place, []).append(job)
    settings, outcomes, tasks = request.settings.for_merging(), dict[str, Outcome](), list[Merge]()
    for name, of_place in members.items():
        done = [job for job in of_place if job.is_done]
        if len(done) < 2:
            continue
        key = key_of("merge", [f"{job.source.name}:{job.key}" for job in done], settings)
        label = find_result(storage, f"{PLACES}/{name}", key)
        if label is not None:
            outcomes[name] = outcome_of_label(label)
            continue
        names = tuple(job.source.name for job in done)
        sources = tuple(job.source.input for job in done)
        tasks.append(Merge(name, names, sources, settings, key, storage.root))
    for task, outcome in _run_all(tasks, executor, "merging", journal, report):
        outcomes[task.name] = outcome
    return [Place(name, of_place, outcomes.get(name)) for name, of_place in members.items()]


def _run_all(
    tasks: Sequence[Task], executor: Executor, what: str, journal: Journal, report: Reporter
) -> Iterator[tuple[Task, Outcome]]:
    """Run tasks, those that were killed or lost their bucket up to three times more; note how each
    ends.

    Raises:
        InputError: a disk is full.
    """
    for task in tasks:
        executor.submit(task)
    ended = 0
    while ended < len(tasks):
        task, outcome, attempt = executor.wait()
        if outcome.status in ("killed", "unreachable") and attempt <= _RETRIES:
            journal.note(outcome.status, what=what, name=task.name, why=outcome.why)
            executor.submit(task, attempt + 1, avoid=outcome.worker)
            continue
        if outcome.status == "full":
            raise InputError(f"cannot continue: {outcome.why}", hint=MAKE_ROOM)
        if outcome.status == "killed":
            why = f"{outcome.why} in {attempt} attempts: is there enough memory?"
            outcome = Outcome("failed", why)
        if outcome.status == "unreachable":
            outcome = Outcome("failed", outcome.why)
        ended += 1
        if outcome.status == "failed":
            _fail(task.name, outcome, journal, report, what)
        elif what != "inspecting":
            used = outcome.cpu_seconds, outcome.peak_memory_bytes
            journal.note("done", what=what, name=task.name, cpu_seconds=used[0], memory=used[1])
        report.progress(what, ended, len(tasks), task.name)
        yield task, outcome


def _fail(
    name: str, outcome: Outcome, journal: Journal, report: Reporter, what: str = "inspecting"
) -> None:
    journal.note("failed", what=what, name=name, why=outcome.why)
    report.fail(f"{'place ' * (what == 'merging')}{name}: {outcome.why}")


def _limit_memory(
    waiting: Sequence[Job], request: Request, executor: Executor, report: Reporter
) -> None:
    estimates = [estimate_memory(job.info, request.resolution) for job in waiting]
    most = max(estimates) / _GIGABYTE
    name = waiting[estimates.index(max(estimates))].source.name
    if request.scheduler:
        report.say(f"at most {most:.2g} GB of memory per worker and thread, for {name}")
        return
    given = request.settings.memory
    whose = "of this machine" if given is None else "that are given"
    memory = machine_memory() if given is None else round(given * _GIGABYTE)
    wanted = min(request.jobs, len(waiting))
    jobs = fitting_jobs(estimates, wanted, memory)
    report.say(f"{jobs} at once, each with at most {most:.2g} GB of memory, for {name}")
    if jobs < wanted:
        report.say(
            f"warning: not {wanted} at once: they may need more than the "
            f"{memory / _GIGABYTE:.3g} GB {whose}"
        )
    executor.limit(jobs)


def _known_recordings(journal: Journal) -> dict[str, dict[str, Any]]:
    """The summaries of recordings in the journal, by `_identify`; damaged ones are left out."""
    return {
        entry["task"]: entry["info"]
        for entry in journal.find("inspected")
        if isinstance(entry.get("task"), str) and _is_summary(entry.get("info"))
    }


def _is_summary(info: Any) -> bool:
    checks: dict[str, Callable[[Any], bool]] = {
        "scans": lambda value: type(value) is int,
        "beams": lambda value: type(value) is int,
        "bytes": lambda value: type(value) is int,
        "digest": lambda value: isinstance(value, str),
        "time": lambda value: isinstance(value, dict),
    }
    return isinstance(info, dict) and all(check(info.get(key)) for key, check in checks.items())


def _identify(task: Inspect) -> str:
    """Key of the summary of a recording: all that it depends on."""
    return repr((task.fingerprint, task.settings.describe(), package_version()))


_FACTS = ("scans", "beams", "dimension", "hit_ranges_m", "time", "digest", "bytes")


def _main_facts(info: dict[str, Any]) -> dict[str, Any]:
    """The part of a summary that the fleet uses."""
    return {name: info[name] for name in _FACTS}
