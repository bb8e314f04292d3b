"""How the recordings of a fleet are mapped, and the command lines that say so to stillmap."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

_NO_MATTER = ("threads",)  # options on which no label or map depends


@dataclass(frozen=True)
class Settings:
    """Settings of a task beside its inputs.

    Attributes:
        options: name and JSON value of every option that is not the default.
        use_odometry: whether odometry in the recordings is used.
        keep_poses: whether poses stored in the recordings are kept.
        memory: GB that all tasks may use together; None: what the machine has.
    """

    options: tuple[tuple[str, str], ...] = ()
    use_odometry: bool = True
    keep_poses: bool = False
    memory: float | None = None

    def for_reading(self) -> Self:
        """The part that decides how a recording is read."""
        options = tuple(one for one in self.options if one[0].startswith("read."))
        return replace(self, options=options, use_odometry=True, keep_poses=False)

    def for_merging(self) -> Self:
        """The part that decides how results are merged."""
        return replace(self, use_odometry=True, keep_poses=False)

    def describe(self) -> str:
        """A text that differs where a result may differ."""
        options = [one for one in self.options if one[0] not in _NO_MATTER]
        return json.dumps([options, self.use_odometry, self.keep_poses])


def info_command(recording: Path, settings: Settings) -> list[str]:
    """The command line that prints what is in a recording."""
    return ["info", str(recording), "--json", "--quiet", *_options(settings)]


def map_command(recording: Path, output: Path, settings: Settings) -> list[str]:
    """The command line that maps a recording."""
    odometry = [] if settings.use_odometry else ["--no-odometry"]
    poses = ["--poses", "recording"] if settings.keep_poses else []
    words = ["map", str(recording), "-o", str(output), "--quiet"]
    return [*words, *_options(settings), *_memory(settings), *odometry, *poses]


def merge_command(results: Sequence[Path], output: Path, settings: Settings) -> list[str]:
    """The command line that merges results."""
    words = ["merge", *map(str, results), "-o", str(output), "--quiet"]
    return [*words, *_options(settings), *_memory(settings)]


def _memory(settings: Settings) -> list[str]:
    return [] if settings.memory is None else [f"--memory={settings.memory!r}"]


def _options(settings: Settings) -> list[str]:
    return [f"--set={name}={value}" for name, value in settings.options]
