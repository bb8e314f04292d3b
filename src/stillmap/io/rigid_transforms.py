"""Rigid transforms as files write them: matrices, rows of numbers, quaternions."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

_TOLERANCE = 0.02  # rotations printed with three decimals deviate less

MAX_TRANSLATION = 1e9  # m
MAX_MOUNT = 1e5  # m from the robot's base to a sensor; the kernels' cells end at a few hundred km


def rigid_transform(R: ArrayLike, t: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) transform of a rounded rotation (3, 3), projected onto SO(3), and a translation (m).

    Raises:
        ValueError: R is no rotation within the tolerance, or a number is not finite.
    """
    R, t = np.asarray(R, np.float64).reshape(3, 3), np.asarray(t, np.float64).reshape(3)
    if not (np.isfinite(R).all() and np.all(np.abs(t) < MAX_TRANSLATION)):
        raise ValueError("a pose is not finite")
    is_small = np.abs(R).max() <= 1.0 + _TOLERANCE
    if not is_small or np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError("a pose has no rotation matrix")
    if not np.array_equal(R @ R.T, np.eye(3)):  # an exact rotation stays bit-identical
        U, _, Vt = np.linalg.svd(R)
        R = U @ Vt
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def are_rigid(T: NDArray[np.float64]) -> bool:
    """True if all of (N, D+1, D+1) matrices are rigid transforms within the tolerance."""
    D = T.shape[-1] - 1
    R, t = T[:, :D, :D], T[:, :D, D]
    if not ((np.abs(R) <= 1.0 + _TOLERANCE).all() and (np.abs(t) < MAX_TRANSLATION).all()):
        return False
    is_orthogonal = np.abs(R @ R.swapaxes(1, 2) - np.eye(D)) <= _TOLERANCE
    is_affine = (np.abs(T[:, D] - np.eye(D + 1)[D]) <= _TOLERANCE).all()
    return bool(is_orthogonal.all() and is_affine and (np.linalg.det(R) > 0.0).all())


def pose_from_row(row: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) transform of its first three rows, 12 numbers.

    Raises:
        ValueError: see `rigid_transform`, or another count of numbers.
    """
    upper = np.asarray(row, np.float64).reshape(3, 4)
    return rigid_transform(upper[:, :3], upper[:, 3])


def pose_from_quaternion(wxyz: ArrayLike, t: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) transform of a quaternion w x y z and a translation in metres.

    Raises:
        ValueError: the quaternion is not of norm one, or a number is not finite.
    """
    q = np.asarray(wxyz, np.float64)
    if not abs(np.linalg.norm(q) - 1.0) < _TOLERANCE:
        raise ValueError("a quaternion is not of norm one")
    from scipy.spatial.transform import Rotation  # slow to load

    return rigid_transform(Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), t)


def quaternion_from_pose(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4) quaternions w x y z, w >= 0, of transforms (..., 4, 4)."""
    from scipy.spatial.transform import Rotation

    xyzw = Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)
    return np.asarray(xyzw)[..., [3, 0, 1, 2]]


def embed_in_3d(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4, 4) poses of (..., D+1, D+1); 2D poses lie at z = 0."""
    if T.shape[-1] == 4:
        return T
    out = np.zeros((*T.shape[:-2], 4, 4))
    out[..., :2, :2], out[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out
