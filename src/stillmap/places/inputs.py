"""The inputs of a merge: recordings, result folders, or a place."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stillmap.core.errors import InputError
from stillmap.core.short_repr import ShortRepr
from stillmap.io.registry import detect_format
from stillmap.places.prepare import MappedRecording
from stillmap.results.folder import is_result
from stillmap.results.pose_graph_g2o import read_g2o
from stillmap.results.run_json import RECORD, TILTING
from stillmap.results.saved import SavedResult, load

SESSIONS = "sessions.json"  # every place has it


@dataclass(frozen=True, eq=False)
class SessionInput(ShortRepr):
    """One session to be merged.

    Attributes:
        name: unique in its place.
        parts: paths of its recording, several where it was recorded in parts; or of one result.
        is_result: whether it was mapped already.
    """

    name: str
    parts: tuple[Path, ...]
    is_result: bool


def is_place(path: Path) -> bool:
    """Whether a folder is a place."""
    return (path / SESSIONS).is_file() and (path / RECORD).is_file()


def list_sessions(
    groups: Sequence[Sequence[str | os.PathLike[str]]], taken: Sequence[str] = ()
) -> list[SessionInput]:
    """The sessions of inputs, each a group of paths that belong together.

    Args:
        groups: of recordings, or single result folders.
        taken: names that are in use.

    Raises:
        InputError: something is not there, or neither a recording nor a result.
    """
    out, names = list[SessionInput](), set(taken)
    for group in groups:
        paths = tuple(Path(one) for one in group)
        for path in paths:
            if is_place(path):
                hint = "a place goes first: stillmap merge PLACE SESSION... -o PLACE"
                raise InputError("is a place, among sessions", where=str(path), hint=hint)
            if not is_result(path):
                detect_format(path)  # refuses what nobody can read, before any work
        mapped = len(paths) == 1 and is_result(paths[0])
        name = _unique(_stem(paths[0]), names)
        names.add(name)
        out.append(SessionInput(name, paths, mapped))
    return out


def _stem(path: Path) -> str:
    """The name of an input without endings."""
    name = Path(os.path.abspath(path)).name
    stem = name.split(".")[0] or name
    return stem.replace("/", "_")


def _unique(stem: str, names: set[str]) -> str:
    if stem not in names:
        return stem
    return next(name for k in range(2, len(names) + 3) if (name := f"{stem}-{k}") not in names)


def load_mapped(name: str, folder: Path, threads: int) -> tuple[MappedRecording, SavedResult]:
    """A result folder as a session.

    Raises:
        InputError: a file is missing or damaged, or the recording is not there any more.
    """
    if (folder / TILTING).is_dir():
        raise InputError("is a rig with a tilting laser, which is not merged", where=str(folder))
    result = load(folder)
    graph = folder / "graph.g2o"
    output = result.options.output
    mapped = MappedRecording(
        name,
        result.deskewed,
        result.poses,
        np.asarray(result.p_static),
        read_g2o(graph) if graph.is_file() else None,
        (output.min_obstacle_height, output.max_obstacle_height),
        threads,
    )
    return mapped, result


def copy_record(result: Path, folder: Path) -> None:
    """Copy what describes how a session was read and mapped."""
    shutil.copyfile(result / RECORD, folder / RECORD)
