"""Relations between poses: pairs of scans of one place, from the truth or from files beside a log.

As Kuemmerle et al. 2009 judge trajectories, see `stillmap.results.eval.trajectory`.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from stillmap.core import se2
from stillmap.results.eval.readers import read_relations, to_seconds
from stillmap.results.eval.trajectory import RelationErrors, compute_relation_errors
from stillmap.sim import load_truth
from stillmap.sim.truth import FOLDER

Float = NDArray[np.float64]
Index = NDArray[np.intp]

PAIRS = 1000  # per recording
REACH = 5.0  # m between the two
_LOG = ".clf.gz"


def near_pairs(
    positions: Float, rng: np.random.Generator, count: int = PAIRS, reach: float = REACH
) -> tuple[Index, Index]:
    """Two scans each, the earlier one first: any scan, and any other near it, whenever it was.

    Args:
        positions: (T, 2) m, T >= 2.
        rng: says which.
        count: pairs; fewer where scans have no other near them.
        reach: m.
    """
    tree, pairs = KDTree(positions), []
    for one in rng.integers(len(positions), size=count).tolist():
        near = tree.query_ball_point(positions[one], reach, return_sorted=True)
        near.remove(one)
        if near:
            pairs.append(sorted((one, near[rng.integers(len(near))])))
    first, second = np.array(pairs, np.intp).reshape(-1, 2).T
    return first, second


def timed_poses(stamp_ns: NDArray[np.int64], poses: Float) -> Float:
    """(T, 4) t, x, y, theta in seconds, metres, radians."""
    return np.column_stack([to_seconds(stamp_ns), se2.parameters(poses)])


def relations_of(stamp_ns: NDArray[np.int64], truth: Float, first: Index, second: Index) -> Float:
    """(R, 8) true displacements between scans, as relation files have them."""
    known, zero = timed_poses(stamp_ns, truth), np.zeros(len(first))
    x, y, theta = se2.parameters(se2.inverse(truth[first]) @ truth[second]).T
    return np.column_stack([known[first, 0], known[second, 0], x, y, *[zero] * 3, theta])


def errors_of(
    stamp_ns: NDArray[np.int64], poses: Float, truth: Float, first: Index, second: Index
) -> RelationErrors:
    """What poses (T, 3, 3) make of the true displacements between scans."""
    relations = relations_of(stamp_ns, truth, first, second)
    return compute_relation_errors(timed_poses(stamp_ns, poses), relations)


def name_of(recording: Path) -> str:
    """What a log or a recording folder is called."""
    return recording.name.removesuffix(_LOG)


def relations_beside(log: Path) -> Path:
    """NAME.relations beside NAME.clf.gz, else NAME.pseudo.relations."""
    verified = log.with_name(f"{name_of(log)}.relations")
    return verified if verified.exists() else verified.with_suffix(".pseudo.relations")


def known_relations(recording: Path, stamp_ns: NDArray[np.int64]) -> Float:
    """(R, 8) of a log those in the file beside it; of a simulation some of its truth."""
    if not (recording / FOLDER).is_dir():
        return read_relations(relations_beside(recording))
    truth = load_truth(recording).T_world_base
    pairs = near_pairs(truth[:, :2, 2], np.random.default_rng(0))
    return relations_of(stamp_ns, truth, *pairs)
