"""Scores of labels in space: what others publish, and what P(static) is worth."""

from pathlib import Path

import numpy as np
from common import Scores
from numpy.typing import NDArray
from space_cases import LASTING, NOBODY, Known, known_of_given

from stillmap.results.eval.labels import score_labels

_NAN = float("nan")


def accuracies(p_static: NDArray[np.floating], static: NDArray[np.bool_]) -> Scores:
    """SA, DA, HA in percent, of P(static) (n,) and the truth (n,).

    The share of static beams called static, that of dynamic beams called dynamic, and the harmonic
    mean of both (Zhang et al. 2023, "A dynamic points removal benchmark in point cloud maps").
    Beams without a label (NaN) stay in the map: static.
    """
    dynamic = p_static < 0.5
    sa = 100.0 * float(np.mean(~dynamic[static])) if static.any() else _NAN
    da = 100.0 * float(np.mean(dynamic[~static])) if not static.all() else _NAN
    ha = 2.0 * sa * da / (sa + da) if sa + da > 0.0 else 0.0 if sa + da == 0.0 else _NAN
    return {"sa": sa, "da": da, "ha": ha}


def scores(p_static: NDArray[np.floating], known: Known, certain: bool) -> Scores:
    """Everything of the beams whose truth is known.

    Args:
        p_static: (K,).
        known: the truth of these.
        certain: labels are 0 or 1, and probabilities are not scored.
    """
    p, static, kind, rested = (
        one[known.scored] for one in (p_static, known.static, known.kind, known.rested)
    )
    out: Scores = {**accuracies(p, static), "n_static": static.sum(), "n_dynamic": (~static).sum()}
    for number, name in enumerate(known.kinds):
        if name != NOBODY and (of := kind == number).any():
            out[f"recall_{name}"] = 100.0 * float(np.mean(p[of] < 0.5))
            out[f"n_{name}"] = float(of.sum())
    lasting = np.isin(kind, [known.kinds.index(n) for n in LASTING if n in known.kinds])
    if lasting.any():
        out["ha_without"] = accuracies(p[~lasting], static[~lasting])["ha"]
    if rested.any():
        out["ha_moved"] = accuracies(p[~rested], static[~rested])["ha"]
        out["rested"] = 100.0 * float(np.mean(rested[~static]))
    if not certain:
        labels = score_labels(p, static, np.ones(len(p), np.bool_))
        out |= {
            "ap": labels.average_precision,
            "brier": labels.brier,
            "ece": labels.ece,
            "ece_unsure": labels.ece_unsure,
            "log_loss": labels.log_loss,
        }
    return {key: float(value) for key, value in out.items()}


def scores_of(work: Path, labels: Path, certain: bool) -> Scores:
    """The same of labels on the disk, for a prepared case."""
    return scores(np.load(labels), known_of_given(work), certain)
