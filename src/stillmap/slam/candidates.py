"""Which keyframes may see again what was seen much earlier, and how sure the graph is of where."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap import se2
from stillmap.slam.loops import Candidate, Closure, LoopOptions, Track, drift
from stillmap.slam.scans import hits

Float = NDArray[np.float64]


def stages(track: Track) -> Iterator[tuple[int, int]]:
    """Ranges first, last of keyframes: each a stage of travel, later ones longer."""
    options, travelled = track.options, track.travelled[track.keyframes]
    first = 0
    while first < len(travelled):
        here = travelled[first]
        until = here + max(options.stage, options.stage_share * here)
        last = max(first + 1, int(np.searchsorted(travelled, until)))
        yield first, last
        first = last


def metres_to(track: Track, k: int, ties: list[Closure]) -> Float:
    """(k + 1,) metres of drift between the keyframes up to k and keyframe k.

    The shortest way through the graph: along the chain, or through a closure, which counts as the
    metres that drift as much as it may be wrong. A loop closed elsewhere shortens no way here.
    """
    from scipy import sparse
    from scipy.sparse import csgraph  # takes long to load

    travelled = track.travelled[track.keyframes[: k + 1]]
    ties = [closure for closure in ties if closure.later <= track.keyframes[k]]
    if not ties:
        along: Float = travelled[k] - travelled
        return along
    scans = np.array([[closure.earlier, closure.later] for closure in ties])
    first, second = np.searchsorted(track.keyframes, scans).T
    # no edge may weigh zero: that would be none
    weights = np.concatenate([np.diff(travelled), _counted(ties, track.options)]).clip(1e-9)
    ends = np.append(np.arange(k), first), np.append(np.arange(1, k + 1), second)
    graph = sparse.csr_array((weights, ends), shape=(k + 1, k + 1))
    metres: Float = csgraph.dijkstra(graph, directed=False, indices=[k])[0]
    return metres


def _counted(ties: list[Closure], options: LoopOptions) -> Float:
    """(L,) metres of drift that closures count as."""
    covariance = np.array([closure.covariance[:2, :2] for closure in ties])
    sigma: Float = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    return sigma / max(options.drift_translation, 1e-9)


def looks(track: Track) -> Float:
    """(K, 2) where the keyframes look: the mean of what each saw, in its frame."""
    out = np.zeros((len(track.keyframes), 2))
    keyframes = track.recording.in_turn(track.keyframes.tolist(), track.e)
    for k, t in enumerate(keyframes):
        scan = hits(track.recording, track.e, t)
        if scan.weights.sum() > 0.0:
            out[k] = np.average(scan.points, axis=0, weights=scan.weights)
    return out


def of_stage(
    track: Track, poses: Float, looks: Float, first: int, last: int, ties: list[Closure]
) -> Iterator[Candidate]:
    """Keyframes of a stage with the nearest of much earlier travel, where that lies within reach.

    If it does not, with the one that looked nearest to where it looks: who comes back on the other
    side of a street is never near where it was.

    Args:
        track: where loops are looked for.
        poses: (K, 3, 3) the keyframes as far as they are corrected.
        looks: (K, 2) where they look, in their frames.
        first, last: the stage.
        ties: closures of earlier stages that are taken for true.
    """
    options, frames = track.options, track.keyframes
    x, travelled = se2.parameters(poses), track.travelled[frames]
    metres = metres_to(track, first, ties)
    looked_at = np.einsum("kij,kj->ki", poses[:, :2, :2], looks) + poses[:, :2, 2]
    for k in range(first, last):
        n = int(np.searchsorted(travelled, travelled[k] - options.gap))
        if n == 0:
            continue
        distance = np.linalg.norm(x[:n, :2] - x[k, :2], axis=1)
        turned = np.abs(se2.wrap(x[:n, 2] - x[k, 2]))
        across = np.linalg.norm(looked_at[:n] - looked_at[k], axis=1)
        # seen from the same side, where there is a choice
        for cost, metres_off in ((distance + turned, distance), (across, across)):
            i = int(np.argmin(cost))
            way = travelled[k] - travelled[i]
            if i < first:
                way = min(way, travelled[k] - travelled[first] + metres[i])
            if metres_off[i] < options.reach + drift(way, options)[0]:
                T = se2.inverse(poses[i]) @ poses[k]
                yield Candidate(int(frames[i]), int(frames[k]), T, float(way))
                break
