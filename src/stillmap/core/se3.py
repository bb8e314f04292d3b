"""SE(3): poses in space as homogeneous matrices, vectorized over leading axes.

A twist is (linear, angular velocity) in the moving frame. `se2.inverse` holds in any dimension.
"""

import numpy as np

from stillmap.core.array_types import Float

_SMALL = 1e-6  # rad, below which the series are exact


def skew(v: Float) -> Float:
    """(..., 3, 3) cross product matrices of vectors (..., 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    out -= np.swapaxes(out, -1, -2).copy()
    return out


def exp(xi: Float) -> Float:
    """(..., 4, 4) transforms of twists (..., 6): Rodrigues' formula and its integral."""
    v, w = xi[..., :3], xi[..., 3:]
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    near = angle < _SMALL
    safe = np.where(near, 1.0, angle)
    W = skew(w)
    WW = W @ W
    a = np.where(near, 1.0, np.sin(safe) / safe)
    b = np.where(near, 0.5, (1.0 - np.cos(safe)) / safe**2)
    c = np.where(near, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    out = np.zeros((*xi.shape[:-1], 4, 4))
    out[..., :3, :3] = np.eye(3) + a * W + b * WW
    out[..., :3, 3] = ((np.eye(3) + b * W + c * WW) @ v[..., None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def log(T: Float) -> Float:
    """(..., 6) twists of transforms (..., 4, 4), rotations below pi."""
    w = log_rotation(T[..., :3, :3])
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    near = angle < 1e-4
    half = np.where(near, 0.5, 0.5 * angle)
    # coefficient of the inverse left Jacobian
    c = np.where(near, 1.0 / 12.0, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    W = skew(w)
    V_inverse = np.eye(3) - 0.5 * W + c * (W @ W)
    v = (V_inverse @ T[..., :3, 3:])[..., 0]
    return np.concatenate([v, w], axis=-1)


def log_rotation(R: Float) -> Float:
    """(..., 3) rotation vectors of rotations (..., 3, 3)."""
    from scipy.spatial.transform import Rotation  # slow to load

    flat = R.reshape(-1, 3, 3)
    if not len(flat):
        return np.zeros((*R.shape[:-2], 3))
    out: Float = np.asarray(Rotation.from_matrix(flat).as_rotvec()).reshape(*R.shape[:-2], 3)
    return out


def adjoint(T: Float) -> Float:
    """(..., 6, 6) adjoint: T exp(xi) = exp(Ad xi) T."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = skew(t) @ R
    return out


def normalize(T: Float) -> Float:
    """(..., 4, 4) poses with exact rotations; products accumulate rounding errors."""
    out = T.copy()
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    out[..., :3, :3] = U @ Vt
    return out
