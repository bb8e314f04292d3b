"""Poses in space as other programs write them: rounded, as quaternions, as rows of numbers."""

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import ArrayLike, NDArray

_TOLERANCE = 0.02  # what three decimals leave of a rotation is well within it
_FAR = 1e9  # m


def transform(R: ArrayLike, t: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) of a rotation (3, 3), as good as it was printed, and a translation (3,) in metres.

    Raises:
        ValueError: no rotation, or not finite.
    """
    R, t = np.asarray(R, np.float64).reshape(3, 3), np.asarray(t, np.float64).reshape(3)
    if not (np.isfinite(R).all() and np.all(np.abs(t) < _FAR)):
        raise ValueError("a pose is not finite")
    if np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError("a pose does not turn as a body does")
    T = np.eye(4)
    # a rotation that is one to the last bit stays so
    T[:3, :3] = R if np.array_equal(R @ R.T, np.eye(3)) else _nearest(R)
    T[:3, 3] = t
    return T


def from_row(row: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) of the 12 numbers of its first three rows.

    Raises:
        ValueError: see `transform`; or another number of numbers.
    """
    upper = np.asarray(row, np.float64).reshape(3, 4)
    return transform(upper[:, :3], upper[:, 3])


def from_quaternion(wxyz: ArrayLike, t: ArrayLike) -> NDArray[np.float64]:
    """(4, 4) of a quaternion, its real part first, and a translation in metres.

    Raises:
        ValueError: a quaternion that is not of length one, or not finite.
    """
    q = np.asarray(wxyz, np.float64)
    if not abs(np.linalg.norm(q) - 1.0) < _TOLERANCE:
        raise ValueError("a quaternion is not of length one")
    return transform(scipy.spatial.transform.Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), t)


def quaternion(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4) w x y z of (..., 4, 4), w not negative."""
    xyzw = scipy.spatial.transform.Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)
    return np.asarray(xyzw)[..., [3, 0, 1, 2]]


def in_space(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 4, 4) of poses (..., D+1, D+1); those of the plane lie at height 0."""
    if T.shape[-1] == 4:
        return T
    out = np.zeros((*T.shape[:-2], 4, 4))
    out[..., :2, :2], out[..., :2, 3] = T[..., :2, :2], T[..., :2, 2]
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def _nearest(R: NDArray[np.float64]) -> NDArray[np.float64]:
    U, _, Vt = np.linalg.svd(R)
    nearest: NDArray[np.float64] = U @ Vt
    return nearest
