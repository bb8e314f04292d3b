"""Groups recordings into runs: parts of one run belong together, others are sessions."""

from collections.abc import Sequence
from dataclasses import dataclass

from stillmap.io.parts.facts import RecordingFacts
from stillmap.io.parts.seams import Seam, compare, format_duration


@dataclass(frozen=True)
class Group:
    """Recordings that belong together.

    Attributes:
        members: their indices, in order of time.
        why: one sentence.
    """

    members: tuple[int, ...]
    why: str

    @property
    def kind(self) -> str:
        """`parts` of one run, or a `recording` of its own."""
        return "parts" if len(self.members) > 1 else "recording"


def group_parts(facts: Sequence[RecordingFacts]) -> list[Group]:
    """Group recordings into runs, in the order of the first member that was given.

    Args:
        facts: of the recordings, in any order.
    """
    order = sorted(range(len(facts)), key=lambda k: (facts[k].first_ns, facts[k].last_ns, k))
    runs: list[list[int]] = []
    tails: list[int] = []  # of each run, the part that ends last
    seams: dict[int, tuple[int, Seam]] = {}  # of a part: the one before it
    for k in order:
        found = [
            (seam.step or 0.0, abs(seam.gap), run, seam)
            for run, tail in enumerate(tails)
            if isinstance(seam := compare(facts[tail], facts[k]), Seam)
        ]
        if not found:
            runs.append([k])
            tails.append(k)
            continue
        _, _, run, seam = min(found, key=lambda one: one[:3])
        seams[k] = (tails[run], seam)
        runs[run].append(k)
        if facts[k].last_ns > facts[tails[run]].last_ns:
            tails[run] = k
    groups = [Group(tuple(run), _explain(run, seams, facts)) for run in runs]
    return sorted(groups, key=lambda group: min(group.members))


def _explain(
    run: list[int], seams: dict[int, tuple[int, Seam]], facts: Sequence[RecordingFacts]
) -> str:
    if len(facts) == 1:
        return "the only input"
    if len(run) == 1:
        return _explain_single(run[0], facts)
    told = [_describe_seam(facts[k].path, facts[seams[k][0]].path, seams[k][1]) for k in run[1:]]
    return "; ".join(told)


def _describe_seam(path: str, before: str, seam: Seam) -> str:
    if seam.repeated:
        scans = "scan" if seam.repeated == 1 else f"{seam.repeated} scans"
        text = f"{path} repeats the last {scans} of {before}"
    elif seam.gap > 0.0:
        text = f"{path} begins {format_duration(seam.gap)} after {before} ends"
    else:
        text = f"{path} begins when {before} ends"
    if seam.step is not None:
        text += f", odometry {seam.step:.2f} m apart"
    return text


def _explain_single(k: int, facts: Sequence[RecordingFacts]) -> str:
    """Why a recording is no part of the one that is nearest in time."""

    def pause(n: int) -> tuple[float, int]:
        a, b = facts[k], facts[n]
        return max(b.first_ns - a.last_ns, a.first_ns - b.last_ns, 0), n

    nearest = min((n for n in range(len(facts)) if n != k), key=pause)
    earlier, later = sorted((k, nearest), key=lambda n: (facts[n].first_ns, facts[n].last_ns, n))
    why = compare(facts[earlier], facts[later])
    if isinstance(why, Seam):
        return f"{facts[nearest].path} goes on elsewhere"
    return f"{facts[later].path} {why}"
