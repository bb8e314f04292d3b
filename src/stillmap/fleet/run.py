"""A fleet from its inputs to its page: expand, inspect, plan, map, merge, write."""

from stillmap.core.files import to_encodable
from stillmap.core.json import to_json
from stillmap.fleet.backends import open_storage
from stillmap.fleet.inputs import find_sources
from stillmap.fleet.jobs import Fleet, Job, Reporter, Request
from stillmap.fleet.journal import Journal
from stillmap.fleet.local_executor import Executor, LocalExecutor
from stillmap.fleet.manifest import is_file_name
from stillmap.fleet.output import explain_full_disk, lock_output, require_fleet
from stillmap.fleet.page import render_page
from stillmap.fleet.phases import inspect, map_recordings, merge_places, plan
from stillmap.fleet.storage import Storage

LIST, PAGE = "fleet.json", "fleet.html"


def run_fleet(request: Request, report: Reporter) -> Fleet:
    """Map every recording, merge each place, and write `fleet.json` and `fleet.html`.

    Raises:
        InputError: the output is taken or in use, an input holds no recording, a disk is full, a
            bucket refuses, no scheduler answers. What was finished stays, and the same request goes
            on from there.
        KeyboardInterrupt: likewise.
    """
    storage = open_storage(request.output)
    journal = Journal(storage)
    require_fleet(storage, journal)
    jobs = [Job(source) for source in find_sources(request.entries, _known_names(journal))]
    with lock_output(storage), explain_full_disk(storage):
        executor = _open_executor(request, storage)
        try:
            _note_start(jobs, journal)
            inspect(jobs, request, executor, journal, report)
            waiting = plan(jobs, request, executor, storage, report)
            map_recordings(waiting, request, storage, executor, journal, report)
            places = merge_places(jobs, request, storage, executor, journal, report)
        finally:
            executor.close()
        fleet = Fleet(jobs, places)
        _write(fleet, storage)
        return fleet


def _open_executor(request: Request, storage: Storage) -> Executor:
    if not request.scheduler:
        storage.remove_unfinished()
        return LocalExecutor(request.jobs)
    from stillmap.fleet.dask_executor import DaskExecutor

    return DaskExecutor(request.scheduler)


def _known_names(journal: Journal) -> dict[str, str]:
    """The names of recordings by input, as earlier runs gave them."""
    return {
        entry["input"]: entry["name"]
        for entry in journal.find("named")
        if isinstance(entry.get("input"), str)
        and isinstance(entry.get("name"), str)
        and is_file_name(entry["name"])
    }


def _note_start(jobs: list[Job], journal: Journal) -> None:
    known = _known_names(journal)
    journal.note("started", recordings=len(jobs))
    for job in jobs:
        if known.get(job.source.input) != job.source.name:
            journal.note("named", input=job.source.input, name=job.source.name)


def _write(fleet: Fleet, storage: Storage) -> None:
    """Write the list and the page, and remove what killed processes left."""
    content = to_json(fleet.to_list(), indent=2)
    storage.write(LIST, content.encode() + b"\n")
    storage.write(PAGE, to_encodable(render_page(fleet)).encode())
    storage.remove_unfinished()
