"""Probabilistic data association of many tracks at once.

Bar-Shalom and Fortmann, *Tracking and Data Association* (1988), for one track. Where tracks compete
for a feature its weight is shared as in R. J. Fitzgerald, *Development of practical PDA logic for
multitarget tracking by microprocessor* (ACC 1986), instead of by joint events over all tracks.
"""

import numpy as np
from numpy.typing import NDArray

from stillmap.em.tracker.options import TrackerOptions
from stillmap.objects.kalman import Motion

Float = NDArray[np.float64]


def gated(motion: Motion, at: Float, options: TrackerOptions) -> NDArray[np.bool_]:
    """(K, F) which features at (F, 2) may be of which track."""
    away = at[None] - motion.x[:, None]
    S = motion.P[:, 0] + options.sigma**2
    return np.asarray((away**2).sum(axis=-1) <= options.gate**2 * S[:, None])


def weights(motion: Motion, at: Float, options: TrackerOptions) -> Float:
    """(K, F) probability that a feature is the one of a track; the rest of a row: none is.

    Args:
        motion: K tracks as predicted.
        at: (F, 2) features, metres in the map frame.
        options: see TrackerOptions.
    """
    away = at[None] - motion.x[:, None]
    S = (motion.P[:, 0] + options.sigma**2)[:, None]
    density = np.exp(-0.5 * (away**2).sum(axis=-1) / S) / (2.0 * np.pi * S)
    G = np.where(gated(motion, at, options), options.detection * density, 0.0)
    in_gate = 1.0 - np.exp(-0.5 * options.gate**2)
    none = options.clutter * (1.0 - options.detection * in_gate)
    return np.asarray(G / (G.sum(axis=1, keepdims=True) + G.sum(axis=0) - G + none))


def updated(motion: Motion, at: Float, beta: Float, sigma: float) -> Motion:
    """After a scan: moved by the mean innovation, less sure by how far innovations spread.

    Args:
        motion: K tracks as predicted.
        at: (F, 2) features.
        beta: (K, F) of `weights`.
        sigma: metres, of a feature beside its person.
    """
    away = at[None] - motion.x[:, None]
    xx, xv, vv = motion.P.T
    S = xx + sigma**2
    gain_x, gain_v = xx / S, xv / S
    mean = (beta[..., None] * away).sum(axis=1)
    squares = (beta * (away**2).sum(axis=-1)).sum(axis=1) - (mean**2).sum(axis=-1)
    # both axes share one covariance, so the spread is that of the mean axis
    less = beta.sum(axis=1) * S - 0.5 * squares
    P = np.stack(
        [xx - gain_x**2 * less, xv - gain_x * gain_v * less, vv - gain_v**2 * less], axis=-1
    )
    return Motion(motion.x + gain_x[:, None] * mean, motion.v + gain_v[:, None] * mean, P)
