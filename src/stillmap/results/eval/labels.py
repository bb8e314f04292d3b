"""Scores of P(static) per beam against the truth. The positive class is *dynamic*."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Index
from stillmap.core.json import to_jsonable


@dataclass(frozen=True)
class Scores:
    """Base of all scores. NaN marks an undefined score."""

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionaries of plain numbers; NaN becomes None, since JSON has no NaN."""
        return dict(to_jsonable(dataclasses.asdict(self)))


# One certain error costs 13.8 nats. Labels are float32: anything below 6e-8 is lost near 1 anyway.
LOG_LOSS_EPS = 1e-6

ECE_BINS = 15

UNSURE = (0.05, 0.95)  # P(dynamic) strictly between counts as unsure

NAN = float("nan")


@dataclass(frozen=True)
class LabelScores(Scores):
    """Scores over the labelled hits. NaN: undefined.

    Attributes:
        hits: beams scored; `dynamic` of them are truly dynamic.
        unlabelled: hits without P(static).
        average_precision: sum of (R_n - R_{n-1}) P_n over falling thresholds.
        precision, recall, f1: for P(dynamic) > 1/2.
        brier: mean squared error of P(dynamic).
        log_loss: nats per beam, probabilities clipped to [LOG_LOSS_EPS, 1 - LOG_LOSS_EPS].
        ece: expected calibration error over ECE_BINS bins of equal width.
        ece_unsure: the same over bins of equal mass of the `unsure` beams, those with
            .05 < P(dynamic) < .95.
        share_called_dynamic: share of beams with P(static) < 1/2.
    """

    hits: int
    dynamic: int
    unlabelled: int
    average_precision: float
    precision: float
    recall: float
    f1: float
    brier: float
    log_loss: float
    ece: float
    unsure: int
    ece_unsure: float
    share_called_dynamic: float


def score_labels(p_static: NDArray[np.floating], static: Bool, hit: Bool) -> LabelScores:
    """Score labels (M,) against truth.

    Args:
        p_static: (M,) P(c = 1) in [0, 1]; NaN where there is no label.
        static: (M,) truth, True where a static object reflected the beam.
        hit: (M,) returns whose truth is known.
    """
    if not p_static.shape == static.shape == hit.shape or p_static.ndim != 1:
        raise ValueError(f"lengths differ: {p_static.shape}, {static.shape}, {hit.shape}")
    labelled = hit & ~np.isnan(p_static)
    p = p_static[labelled].astype(np.float64)
    if len(p) and not (p.min() >= 0 and p.max() <= 1):
        raise ValueError("p_static: probabilities must lie in [0, 1]")
    y = ~static[labelled]
    q = 1.0 - p
    clipped = np.clip(q, LOG_LOSS_EPS, 1.0 - LOG_LOSS_EPS)
    unsure = (q > UNSURE[0]) & (q < UNSURE[1])
    bins_unsure = assign_equal_mass_bins(q[unsure])
    precision, recall, f1 = compute_precision_recall_f1(p < 0.5, y)
    return LabelScores(
        hits=len(p),
        dynamic=int(y.sum()),
        unlabelled=int(np.count_nonzero(hit & ~labelled)),
        # ranked by p itself: 1 - p would tie labels that differ by less than 1e-16
        average_precision=compute_average_precision(-p, y),
        precision=precision,
        recall=recall,
        f1=f1,
        brier=mean((q - y) ** 2),
        log_loss=mean(-np.log(np.where(y, clipped, 1.0 - clipped))),
        ece=compute_calibration_error(q, y, assign_equal_width_bins(q)),
        unsure=int(unsure.sum()),
        ece_unsure=compute_calibration_error(q[unsure], y[unsure], bins_unsure),
        share_called_dynamic=mean((p < 0.5).astype(np.float64)),
    )


def compute_average_precision(score: Float, positive: Bool) -> float:
    """Step-wise sum of (R_n - R_{n-1}) P_n, n over the distinct scores from high to low.

    Equal scores share one threshold, so their order cannot matter. NaN without a positive.
    """
    n_positive = int(positive.sum())
    if not n_positive:
        return NAN
    order = np.argsort(-score, kind="stable")
    last_of_ties = np.append(np.flatnonzero(np.diff(score[order])), len(score) - 1)
    true_positives = np.cumsum(positive[order])[last_of_ties]
    precision = true_positives / (last_of_ties + 1)
    return float(np.sum(np.diff(true_positives, prepend=0) * precision) / n_positive)


def compute_precision_recall_f1(called: Bool, positive: Bool) -> tuple[float, float, float]:
    """Precision, recall and F1 of the mask `called`; NaN where a denominator is zero."""
    masks = (called & positive, called, positive)
    both, n_called, n_positive = (int(np.count_nonzero(mask)) for mask in masks)
    return (
        both / n_called if n_called else NAN,
        both / n_positive if n_positive else NAN,
        2 * both / (n_called + n_positive) if n_called + n_positive else NAN,
    )


def assign_equal_width_bins(p: Float, bins: int = ECE_BINS) -> Index:
    """Bin of each probability: [0, 1/bins), ..., [1 - 1/bins, 1]."""
    return np.minimum((p * bins).astype(np.intp), bins - 1)


def assign_equal_mass_bins(p: Float, bins: int = ECE_BINS) -> Index:
    """Quantile bin of each probability; equal ones share a bin."""
    _, group, size = np.unique(p, return_inverse=True, return_counts=True)
    middle = np.cumsum(size) - size / 2
    return (middle * bins / max(len(p), 1)).astype(np.intp)[group]


def compute_calibration_error(p: Float, positive: Bool, bin_of: Index) -> float:
    """Mean over all beams of |share of positives - mean p| of their bin (Naeini et al. 2015)."""
    if not len(p):
        return NAN
    surplus = np.bincount(bin_of, weights=positive - p)
    return float(np.abs(surplus).sum() / len(p))


def mean(values: NDArray[Any]) -> float:
    """Mean of (n,) numbers; NaN of none."""
    return float(values.mean()) if len(values) else NAN
