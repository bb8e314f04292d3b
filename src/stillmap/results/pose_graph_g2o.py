"""`graph.g2o`: the pose graph as text that g2o and GTSAM read (Kuemmerle et al., ICRA 2011).

g2o's SE(2) error is x, y, heading in the frame of the second pose as it was measured. Constraint
covariances are given in that frame, so the information matrix is their plain inverse; GTSAM's
errors differ in second order only. In 3D the information is that of translation, then rotation
vector, as GTSAM reads it.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.input_files import read_text
from stillmap.io.trajectory import pose_rows, poses_from_rows
from stillmap.slam import PoseGraph
from stillmap.slam.pose_graph import Constraint

Float = NDArray[np.float64]

_VERTEX = {2: "VERTEX_SE2", 3: "VERTEX_SE3:QUAT"}
_EDGE = {2: "EDGE_SE2", 3: "EDGE_SE3:QUAT"}
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
    ids, rows, edges, D = list[int](), list[list[float]](), list[list[str]](), 0
    for number, line in enumerate(_read_lines(path), start=1):
        tag, *words = line.split() or [""]
        try:
            if tag in _VERTEX.values():
                D = 2 if tag == _VERTEX[2] else 3
                ids.append(int(words[0]))
                rows.append(_floats(words[1:], 3 if D == 2 else 7))
            elif tag in _EDGE.values():
                edges.append([tag, *words])
        except (ValueError, IndexError) as error:
            raise _damage_error(path, number, error) from error
    if not ids or np.any(np.diff(ids) <= 0):
        raise InputError("is damaged: vertices are missing or out of order", where=str(path))
    return PoseGraph(
        np.array(ids, np.intp), _to_poses(np.array(rows)), _read_edges(path, edges, ids, D)
    )


def _read_edges(path: Path, edges: list[list[str]], ids: list[int], D: int) -> list[Constraint]:
    """The constraints of the words of edges between vertices.

    Raises:
        InputError: an edge is damaged.
    """
    if not edges:
        return []
    try:
        ends, rows = zip(*(_parse_edge(edge, ids, D) for edge in edges), strict=True)
        values = np.array(rows)
        n_pose, dof = (3, 3) if D == 2 else (7, 6)
        upper = np.zeros((len(edges), dof, dof))
        row, column = np.triu_indices(dof)
        upper[:, row, column] = upper[:, column, row] = values[:, n_pose:]
        covariance = np.asarray(np.linalg.inv(upper), np.float64)
        bad = np.flatnonzero(np.linalg.eigvalsh(covariance)[:, 0] <= 0.0)
        if len(bad):
            between = " to ".join(edges[int(bad[0])][1:3])
            raise ValueError(f"the information of {between} is not positive definite")
        poses = _to_poses(values[:, :n_pose])
    except (ValueError, IndexError, np.linalg.LinAlgError) as error:
        raise InputError(f"is damaged: an edge: {error}", where=str(path)) from error
    return [
        Constraint(first, second, T, covariance[k])
        for k, ((first, second), T) in enumerate(zip(ends, poses, strict=True))
    ]


def _read_lines(path: Path) -> list[str]:
    try:
        return read_text(path, _MAX_BYTES).splitlines()
    except UnicodeDecodeError as error:
        raise InputError("is damaged: no text", where=str(path)) from error


def _damage_error(path: Path, number: int, error: Exception) -> InputError:
    return InputError(f"is damaged: {error}", where=f"{path}, line {number}")


def _floats(words: list[str], count: int) -> list[float]:
    values = [float(word) for word in words]
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ValueError(f"expected {count} finite numbers, got {' '.join(words)!r}")
    return values


def _to_poses(rows: Float) -> Float:
    return se2.matrix(*rows.T) if rows.shape[1] == 3 else poses_from_rows(rows)


def _parse_edge(edge: list[str], ids: list[int], D: int) -> tuple[tuple[int, int], list[float]]:
    """The indices of both vertices of an edge, and its numbers."""
    tag, one, other, *words = edge
    if tag != _EDGE[D]:
        raise ValueError(f"{tag} among vertices of {D}D")
    first, second = (bisect_left(ids, int(word)) for word in (one, other))
    if (
        first == len(ids)
        or second == len(ids)
        or [ids[first], ids[second]] != [int(one), int(other)]
    ):
        raise ValueError(f"no vertex {one} or {other}")
    n_pose, dof = (3, 3) if D == 2 else (7, 6)
    return (first, second), _floats(words, n_pose + dof * (dof + 1) // 2)
