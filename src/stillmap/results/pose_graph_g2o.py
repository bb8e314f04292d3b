"""`graph.g2o`: the pose graph as text that g2o and GTSAM read (Kuemmerle et al., ICRA 2011).

g2o's SE(2) error is x, y, heading in the frame of the second pose as it was measured. Constraint
covariances are given in that frame, so the information matrix is their plain inverse; GTSAM's
errors differ in second order only.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.slam import PoseGraph
from stillmap.slam.pose_graph import Constraint

Float = NDArray[np.float64]


def write_g2o(path: Path, graph: PoseGraph, poses: Float) -> None:
    """Write one vertex per keyframe, the first one fixed, and one edge per constraint.

    Args:
        path: the file.
        graph: constraints between keyframes; vertex ids are their scan numbers.
        poses: (T, 3, 3) T_map_base of all scans: where the vertices are.
    """
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(f"{line}\n" for line in _lines(graph, poses))


def _lines(graph: PoseGraph, poses: Float) -> Iterator[str]:
    ids = graph.keyframes.tolist()
    for id_, x in zip(ids, se2.parameters(poses[graph.keyframes]), strict=True):
        yield f"VERTEX_SE2 {id_} {_numbers(x)}"
    for constraint in graph.constraints:
        ends = f"{ids[constraint.first]} {ids[constraint.second]}"
        measured = _numbers(se2.parameters(constraint.T))
        yield f"EDGE_SE2 {ends} {measured} {_numbers(_information(constraint))}"
    for first in ids[:1]:
        yield f"FIX {first}"  # last: GTSAM reads no edge after it


def _information(constraint: Constraint) -> Float:
    """(6,) I11 I12 I13 I22 I23 I33 of x, y, heading."""
    information = np.linalg.inv(constraint.covariance)
    upper: Float = (0.5 * (information + information.T))[np.triu_indices(3)]
    return upper


def _numbers(values: Float) -> str:
    # as many digits as tell a number from its neighbours
    return " ".join(repr(value) for value in values.tolist())
