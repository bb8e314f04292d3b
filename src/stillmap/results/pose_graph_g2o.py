"""`graph.g2o`: the pose graph as text that g2o and GTSAM read (Kuemmerle et al., ICRA 2011).

g2o's SE(2) error is x, y, heading in the frame of the second pose as it was measured. Constraint
covariances are given in that frame, so the information matrix is their plain inverse; GTSAM's
errors differ in second order only. In 3D the information is that of translation, then rotation
vector, as GTSAM reads it.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.errors import InputError
from stillmap.core.files import read_text
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
    for id_, x in zip(ids, _to_rows(poses[graph.keyframes]), strict=True):
        yield f"{_VERTEX[D]} {id_} {_numbers(x)}"
    for constraint in graph.constraints:
        ends = f"{ids[constraint.first]} {ids[constraint.second]}"
        [measured] = _to_rows(constraint.T[None])
        yield f"{_EDGE[D]} {ends} {_numbers(measured)} {_numbers(_information(constraint))}"
    for first in ids[:1]:
        yield f"{_FIX} {first}"  # last: GTSAM reads no edge after it


def _to_rows(poses: Float) -> Float:
    """(K, 3) x, y, heading; (K, 7) x, y, z and quaternion of 3D poses."""
    return se2.parameters(poses) if poses.shape[-1] == 3 else pose_rows(poses)


def _information(constraint: Constraint) -> Float:
    """The upper triangle of the information matrix, row by row."""
    information = np.linalg.inv(constraint.covariance)
    upper: Float = (0.5 * (information + information.T))[np.triu_indices(len(information))]
    return upper


def _numbers(values: Float) -> str:
    # as many digits as tell a number from its neighbours
    return " ".join(repr(value) for value in values.tolist())


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
    try:
        constraints = [_to_constraint(edge, ids, D) for edge in edges]
    except (ValueError, IndexError, np.linalg.LinAlgError) as error:
        raise InputError(f"is damaged: an edge: {error}", where=str(path)) from error
    return PoseGraph(np.array(ids, np.intp), _to_poses(np.array(rows)), constraints)


def _read_lines(path: Path) -> list[str]:
    try:
        return read_text(path, _MAX_BYTES).splitlines()
    except UnicodeDecodeError as error:
        raise InputError("is damaged: no text", where=str(path)) from error


def _damage_error(path: Path, number: int, error: Exception) -> InputError:
    return InputError(f"is damaged: {error}", where=f"{path}, line {number}")


def _floats(words: list[str], count: int) -> list[float]:
    values = [float(word) for word in words]
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"expected {count} finite numbers, got {' '.join(words)!r}")
    return values


def _to_poses(rows: Float) -> Float:
    return se2.matrix(*rows.T) if rows.shape[1] == 3 else poses_from_rows(rows)


def _to_constraint(edge: list[str], ids: list[int], D: int) -> Constraint:
    tag, one, other, *words = edge
    if tag != _EDGE[D]:
        raise ValueError(f"{tag} among vertices of {D}D")
    first, second = (int(np.searchsorted(ids, int(word))) for word in (one, other))
    if (
        first == len(ids)
        or second == len(ids)
        or [ids[first], ids[second]] != [int(one), int(other)]
    ):
        raise ValueError(f"no vertex {one} or {other}")
    n_pose, dof = (3, 3) if D == 2 else (7, 6)
    values = np.array(_floats(words, n_pose + dof * (dof + 1) // 2))
    information = np.zeros((dof, dof))
    information[np.triu_indices(dof)] = values[n_pose:]
    information += np.triu(information, 1).T
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise ValueError(f"the information of {one} to {other} is not positive definite")
    return Constraint(first, second, _to_poses(values[None, :n_pose])[0], covariance)
