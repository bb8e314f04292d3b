"""SE(2): poses in the plane as homogeneous matrices, vectorized over leading axes."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillmap.core.array_types import Float


def matrix(x: ArrayLike, y: ArrayLike, theta: ArrayLike) -> Float:
    """(..., 3, 3) homogeneous matrices of x, y (m) and theta (rad)."""
    if isinstance(theta, float) and isinstance(x, float) and isinstance(y, float):
        c, s = np.cos(theta), np.sin(theta)
        return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])
    T = np.zeros((*np.broadcast(x, y, theta).shape, 3, 3))
    T[..., 0, 0] = T[..., 1, 1] = np.cos(theta)
    T[..., 1, 0] = np.sin(theta)
    T[..., 0, 1] = -T[..., 1, 0]
    T[..., 0, 2], T[..., 1, 2], T[..., 2, 2] = x, y, 1.0
    return T


def parameters(T: Float) -> Float:
    """(..., 3) x, y, theta of matrices (..., 3, 3); theta in (-pi, pi]."""
    x = np.empty((*T.shape[:-2], 3))  # np.stack would take twice as long for a single pose
    x[..., :2] = T[..., :2, 2]
    x[..., 2] = np.arctan2(T[..., 1, 0], T[..., 0, 0])
    return x


def normalize(T: Float) -> Float:
    """(..., 3, 3) poses with exact rotations; products accumulate rounding errors."""
    x = parameters(T)
    return matrix(x[..., 0], x[..., 1], x[..., 2])


def inverse(T: Float) -> Float:
    """Inverses of rigid transforms (..., D+1, D+1), any D."""
    out = T.swapaxes(-1, -2).copy()
    out[..., :-1, -1:] = -(out[..., :-1, :-1] @ T[..., :-1, -1:])
    out[..., -1, :-1] = 0.0
    return out


def increments(T: Float) -> Float:
    """Motions (n - 1, D + 1, D + 1) between successive poses (n, D + 1, D + 1)."""
    return np.asarray(inverse(T[:-1]) @ T[1:])


def log(T: Float) -> Float:
    """(..., 3) twists x, y, theta of transforms (..., 3, 3): constant motion along an arc."""
    x, y, theta = np.moveaxis(parameters(T), -1, 0)
    half = 0.5 * theta
    c, s = np.cos(half), np.sin(half)
    # the chord is rotated by half the angle and shorter than the arc
    arc = 1.0 / sinc(half, s)
    return np.stack([arc * (c * x + s * y), arc * (c * y - s * x), theta], axis=-1)


def exp(xi: Float) -> Float:
    """(..., 3, 3) transforms of twists (..., 3) x, y, theta; the inverse of `log`."""
    x, y, theta = np.moveaxis(xi, -1, 0)
    half = 0.5 * theta
    c, s = np.cos(half), np.sin(half)
    chord = sinc(half, s)
    return matrix(chord * (c * x - s * y), chord * (s * x + c * y), theta)


def sinc(angle: Float, sine: Float) -> Float:
    """sin(angle) / angle, 1 at 0."""
    return np.divide(sine, angle, out=np.ones_like(sine), where=angle != 0.0)


def wrap(angle: ArrayLike) -> Float:
    """Wrap angles to [-pi, pi]; odd multiples of pi go to either end."""
    return (np.asarray(angle, float) + np.pi) % (2 * np.pi) - np.pi


def align_points(source: Float, target: Float) -> Float:
    """(D+1, D+1) rigid T that minimises sum |target - T source|^2 over (N, D) points, N >= 1."""
    centre_source, centre_target = source.mean(0), target.mean(0)
    U, _, Vt = np.linalg.svd((target - centre_target).T @ (source - centre_source))
    D = source.shape[1]
    # keep R a rotation: the last axis costs least to reverse
    flip = np.ones(D)
    flip[-1] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    T = np.eye(D + 1)
    T[:D, :D] = (U * flip) @ Vt
    T[:D, D] = centre_target - T[:D, :D] @ centre_source
    return T


def rotate_covariance(covariance: Float, T: Float) -> Float:
    """Rotate covariances of poses by the rotations of poses (..., D+1, D+1).

    They are (..., 3, 3) of x, y and heading, in 3D (..., 6, 6) of translation and rotation.
    """
    D = T.shape[-1] - 1
    R = np.zeros((*T.shape[:-2], 3 * (D - 1), 3 * (D - 1)))
    R[..., :D, :D] = T[..., :D, :D]
    R[..., D:, D:] = T[..., :D, :D] if D == 3 else 1.0
    return R @ covariance @ np.swapaxes(R, -1, -2)


def along_and_across(offset: NDArray[Any], direction: Float) -> tuple[Float, Float]:
    """(...) components of offsets (..., 2) along unit directions (..., 2) and to their left."""
    along = (offset * direction).sum(axis=-1)
    return along, offset[..., 1] * direction[..., 0] - offset[..., 0] * direction[..., 1]


def project_to_plane(poses: Float) -> Float:
    """(T, 3, 3) position and yaw of 3D poses (T, 4, 4)."""
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return matrix(poses[:, 0, 3], poses[:, 1, 3], yaw)
