"""Quality of labels and of geometry from 0 to 100, without truth; `docs/quality.md` defines it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.em import label_quality
from stillmap.slam import surface_agreement

Float = NDArray[np.float64]

_HALF_MARK = 0.05  # m of root mean square displacement at which geometry is 50
_MIN_PAIRS = 10  # of surface patches that two visits show: with fewer nothing can be told


@dataclass(frozen=True)
class Quality:
    """How good a result is, each from 0 (useless) to 100; None where it cannot be told.

    Attributes:
        overall: geometric mean of both parts.
        labels: of P(static).
        geometry: of poses and map.
    """

    overall: float | None = None
    labels: float | None = None
    geometry: float | None = None


@dataclass(frozen=True)
class QualityText:
    """One line in plain English for each part of a `Quality`."""

    overall: str
    labels: str
    geometry: str


def rate_quality(
    deskewed: Recording, poses: Float, p_static: NDArray[np.float32], threads: int = 1
) -> Quality:
    """Rates labels and poses of any estimator by the same evidence.

    Args:
        deskewed: 2D or 3D.
        poses: (T, D+1, D+1) T_map_base.
        p_static: (M,) P(c = 1).
        threads: does not change the result.
    """
    f1 = label_quality.expected_f1(deskewed, poses, p_static, threads)
    labels = None if f1 is None else 100.0 * f1
    found = surface_agreement.measure_displacements(deskewed, poses)
    geometry = None
    if len(found.across) >= _MIN_PAIRS:
        rms = float(np.sqrt(np.average(found.across**2, weights=found.weight)))
        geometry = 100.0 / (1.0 + rms / _HALF_MARK)
    overall = None if labels is None or geometry is None else float(np.sqrt(labels * geometry))
    return Quality(
        *(None if part is None else round(part, 1) for part in (overall, labels, geometry))
    )


def describe_quality(quality: Quality) -> QualityText:
    """One line for each part, for readers who do not know how it is computed."""
    return QualityText(
        overall=_line("overall", quality.overall, _OVERALL),
        labels=_line("labels", quality.labels, _LABELS),
        geometry=_line("geometry", quality.geometry, _GEOMETRY),
    )


# lowest figure of each sentence, best first
_OVERALL = (
    (80.0, "good"),
    (60.0, "usable; see which part is lower"),
    (40.0, "check the map before it is used"),
    (0.0, "do not rely on this map"),
)
_LABELS = (
    (80.0, "what moved is told from what stands still almost everywhere"),
    (60.0, "most of what moved is labelled so, some of it may be missing or some walls lost"),
    (40.0, "many labels are doubtful: moving objects remain, or static ones were removed"),
    (0.0, "the labels do not fit what was observed"),
)
_GEOMETRY = (
    (80.0, "surfaces observed again lie where they were mapped first"),
    (60.0, "surfaces observed again are displaced by a few centimetres in places"),
    (40.0, "parts of the map do not agree: walls observed again lie beside those mapped first"),
    (0.0, "the map is bent or double: walls observed again lie elsewhere"),
)


def _line(name: str, value: float | None, sentences: tuple[tuple[float, str], ...]) -> str:
    if value is None:
        return f"{name}: cannot be told from this recording"
    sentence = next(text for lowest, text in sentences if value >= lowest)
    return f"{name} {value:.0f} of 100: {sentence}"
