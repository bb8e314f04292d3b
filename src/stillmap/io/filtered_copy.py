"""Filtered copies of recordings: the job of their writers, and what they left out."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import release_pages
from stillmap.core.errors import InputError
from stillmap.core.recording import Recording
from stillmap.io.text_lines import Progress
from stillmap.prepare.options import ReadOptions

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FilterJob:
    """A recording to be written again, in its own format, with some beams blanked.

    Attributes:
        source: the file or folder that was read.
        output: the copy; it appears complete or not at all.
        recording: as it was read from `source`.
        blank: (M,) beams to blank.
        options: with which it was read.
        marker: pattern of a file that every folder of the format holds; "": unused, for files.
        overwrite: replace what is there.
        omit: folders inside `source` that are not copied.
        progress: called with the share of the copy that is written, 0 to 1.
        kind: of the bag to write, as `writers.py` names it; "": that of the source, or no bag.
    """

    source: Path
    output: Path
    recording: Recording
    blank: Mask
    options: ReadOptions
    marker: str = ""
    overwrite: bool = False
    omit: tuple[Path, ...] = ()
    progress: Progress | None = None
    kind: str = ""

    def scan_masks(self, count: int) -> list[Mask | None]:
        """(n,) beams to blank of the scan of each of `count` records; None: it was not read.

        Raises:
            InputError: `source` has other records than were read.
        """
        record = self.recording.record
        if record is None or not ((record >= 0) & (record < count)).all():
            raise other_recording_error(self.source)
        masks: list[Mask | None] = [None] * count
        for scan, number in enumerate(record.tolist()):
            masks[number] = self.blank[self.recording.beams_of(scan)]
        return masks

    def report(self, share: float) -> None:
        """Report progress, and release the pages of labels on the way."""
        release_pages(self.blank)
        if self.progress is not None:
            self.progress(share)


class Omissions(NamedTuple):
    """The parts of a recording that a filtered copy lacks.

    Attributes:
        scans: number of scans left out, since nothing is known of their beams.
        notes: on what else is left out or not filtered, a sentence each.
    """

    scans: int = 0
    notes: tuple[str, ...] = ()


def other_recording_error(path: Path) -> InputError:
    """The error for a file or folder that has changed since it was read."""
    return InputError("is not the recording that was mapped: other scans", where=str(path))
