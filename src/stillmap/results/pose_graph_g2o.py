"""`graph.g2o`: the pose graph as text that g2o and GTSAM read (Kuemmerle et al., ICRA 2011).

g2o takes x, y, heading of what the poses say in the frame of the second pose as it was measured. So
are the covariances of relations given, and GTSAM's errors are the same but for their second order.
The information matrix is the inverse of the covariance, then, as it is.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.results.protocols import GraphLike, RelationLike

Float = NDArray[np.float64]


def write_g2o(path: Path, graph: GraphLike, poses: Float) -> None:
    """Write one vertex per keyframe, the first one fixed, and one edge per relation.

    Args:
        path: the file.
        graph: relations between keyframes; those are scans, whose numbers are the vertices' ids.
        poses: (T, 3, 3) T_map_base of all scans: where the vertices are.
    """
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(f"{line}\n" for line in _lines(graph, poses))


def _lines(graph: GraphLike, poses: Float) -> Iterator[str]:
    ids = graph.scans.tolist()
    for id_, x in zip(ids, se2.parameters(poses[graph.scans]), strict=True):
        yield f"VERTEX_SE2 {id_} {_numbers(x)}"
    for relation in graph.relations:
        ends = f"{ids[relation.first]} {ids[relation.second]}"
        measured = _numbers(se2.parameters(relation.T))
        yield f"EDGE_SE2 {ends} {measured} {_numbers(_information(relation))}"
    for first in ids[:1]:
        yield f"FIX {first}"  # last: GTSAM reads no edge after it


def _information(relation: RelationLike) -> Float:
    """(6,) I11 I12 I13 I22 I23 I33 of x, y, heading."""
    information = np.linalg.inv(relation.covariance)
    upper: Float = (0.5 * (information + information.T))[np.triu_indices(3)]
    return upper


def _numbers(values: Float) -> str:
    # as many digits as tell a number from its neighbours
    return " ".join(repr(value) for value in values.tolist())
