"""`graph.g2o`: the pose graph as text that g2o and GTSAM read (Kuemmerle et al., ICRA 2011).

g2o's SE(2) error is x, y, heading in the frame of the second pose as it was measured. Constraint
covariances are given in that frame, so the information matrix is their plain inverse; GTSAM's
errors differ in second order only. In 3D the information is that of translation, then rotation
vector, as GTSAM reads it.
"""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float, Index
from stillmap.core.errors import InputError, explaining_damage
from stillmap.core.input_files import read_text
from stillmap.io.trajectory import pose_rows, poses_from_rows
from stillmap.slam import PoseGraph
from stillmap.slam.pose_graph import Constraint

_VERTEX = {2: "VERTEX_SE2", 3: "VERTEX_SE3:QUAT"}
_EDGE = {2: "EDGE_SE2", 3: "EDGE_SE3:QUAT"}
_SIZES = {2: (3, 3), 3: (7, 6)}  # numbers of a pose, rows of an information matrix
_FIX = "FIX"
_MAX_BYTES = 1 << 30


def write_g2o(path: Path, graph: PoseGraph, poses: Float) -> None:
    """Write one vertex per keyframe, the first one fixed, and one edge per constraint.

    Args:
        path: the file.
        graph: constraints between keyframes; vertex ids are their scan numbers.
        poses: (T, D+1, D+1) T_map_base of all scans: where the vertices are.
    """
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(f"{line}\n" for line in _lines(graph, poses))


def _lines(graph: PoseGraph, poses: Float) -> Iterator[str]:
    ids, D = graph.keyframes.tolist(), poses.shape[-1] - 1
    for id_, x in zip(ids, _to_rows(poses[graph.keyframes]).tolist(), strict=True):
        yield f"{_VERTEX[D]} {id_} {_numbers(x)}"
    for constraint, row in zip(graph.constraints, _edge_rows(graph.constraints, D), strict=True):
        yield f"{_EDGE[D]} {ids[constraint.first]} {ids[constraint.second]} {_numbers(row)}"
    for first in ids[:1]:
        yield f"{_FIX} {first}"  # last: GTSAM reads no edge after it


def _to_rows(poses: Float) -> Float:
    """(K, 3) x, y, heading; (K, 7) x, y, z and quaternion of 3D poses."""
    return se2.parameters(poses) if poses.shape[-1] == 3 else pose_rows(poses)


def _edge_rows(constraints: list[Constraint], D: int) -> list[list[float]]:
    """Of each constraint the measured pose and the upper triangle of the information matrix, row
    by row."""
    if not constraints:
        return []
    measured = _to_rows(np.array([one.T for one in constraints]))
    information = np.linalg.inv(np.array([one.covariance for one in constraints]))
    information = 0.5 * (information + information.swapaxes(1, 2))
    row, column = np.triu_indices(3 * (D - 1))
    rows: list[list[float]] = np.hstack([measured, information[:, row, column]]).tolist()
    return rows


def _numbers(values: list[float]) -> str:
    # as many digits as tell a number from its neighbours
    return " ".join(map(repr, values))


def read_g2o(path: Path) -> PoseGraph:
    """The pose graph that `write_g2o` wrote; all vertices of one dimension.

    Raises:
        InputError: the file is missing or damaged; names the line.
    """
    ids, rows, ends, edges, D = [], list[list[float]](), list[list[int]](), list[list[float]](), 0
    for number, line in enumerate(read_text(path, _MAX_BYTES).splitlines(), start=1):
        tag, *words = line.split() or [""]
        try:
            if tag in _VERTEX.values():
                D = D or (2 if tag == _VERTEX[2] else 3)
                ids.append(int(words[0]))
                rows.append(_floats(words[1:], _SIZES[D][0]))
            elif tag in _EDGE.values():
                n_pose, dof = _SIZES[D]
                ends.append([int(word) for word in words[:2]])
                edges.append(_floats(words[2:], n_pose + dof * (dof + 1) // 2))
        except (ValueError, IndexError, KeyError) as error:
            raise InputError(f"is damaged: {error}", where=f"{path}, line {number}") from error
    if not ids or np.any(np.diff(ids) <= 0):
        raise InputError("is damaged: vertices are missing or out of order", where=str(path))
    with explaining_damage(path, OverflowError, np.linalg.LinAlgError):
        keyframes, poses = np.array(ids, np.intp), _to_poses(np.array(rows))
        return PoseGraph(keyframes, poses, _to_constraints(keyframes, ends, edges, D))


def _to_constraints(
    keyframes: Index, ends: list[list[int]], edges: list[list[float]], D: int
) -> list[Constraint]:
    """The constraints of edges between vertices of these ids.

    Raises:
        ValueError, OverflowError, LinAlgError: an edge is damaged.
    """
    if not edges:
        return []
    of_vertices, values, (n_pose, dof) = np.array(ends, np.intp), np.array(edges), _SIZES[D]
    index = np.searchsorted(keyframes, of_vertices)
    if not np.array_equal(keyframes[index.clip(max=len(keyframes) - 1)], of_vertices):
        raise ValueError("an edge has no vertex")
    information = np.zeros((len(edges), dof, dof))
    row, column = np.triu_indices(dof)
    information[:, row, column] = information[:, column, row] = values[:, n_pose:]
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    if (np.linalg.eigvalsh(covariance)[:, 0] <= 0.0).any():
        raise ValueError("the information of an edge is not positive definite")
    parts = zip(index.tolist(), _to_poses(values[:, :n_pose]), covariance, strict=True)
    return [Constraint(first, second, T, part) for (first, second), T, part in parts]


def _floats(words: list[str], count: int) -> list[float]:
    values = [float(word) for word in words]
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ValueError(f"expected {count} finite numbers, got {' '.join(words)!r}")
    return values


def _to_poses(rows: Float) -> Float:
    return se2.matrix(*rows.T) if rows.shape[1] == 3 else poses_from_rows(rows)
