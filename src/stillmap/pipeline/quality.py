"""Quality of labels and of geometry from 0 to 100, without truth; `docs/estimator.md` defines it.

Every figure comes from the same evidence, in metres and shares, whatever estimator, resolution or
sensor made the result.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from stillmap.core.array_types import Float, Float32
from stillmap.core.recording import Recording
from stillmap.em import OccupancyMap, final_labels
from stillmap.mapping.projection import count_small_pieces
from stillmap.slam import rematching, surface_agreement

# by dimension: disagreement and displacement in m and small pieces per 100 m2 at which that part of
# geometry is 50, and the displacement that counts where nothing is seen again to confirm the map
_SCALE = {2: (0.2, 0.03, 30.0, 0.06), 3: (0.03, 0.06, 10.0, 0.03)}
# what the best of simulated results reach: it is 100
_BEST_F1, _BEST_GEOMETRY = 0.85, 0.8
_JUDGED_SCANS = 120  # at a time: longer and the poses matched anew have drifted
_GEOMETRY_WEIGHT = 0.75  # of overall: poses, walls and ghosts are three of four things to get right


@dataclass(frozen=True)
class QualityEvidence:
    """Measurements from which `Quality` is computed; None where there are too few data.

    Attributes:
        expected_f1: of the label dynamic, from 0 to 1.
        disagreement: metres between the poses and scans matched anew.
        displacement: metres, mean of surfaces seen again.
        small_pieces: of the map, per 100 m2.
    """

    expected_f1: float | None = None
    disagreement: float | None = None
    displacement: float | None = None
    small_pieces: float | None = None


@dataclass(frozen=True)
class Quality:
    """Quality of a result, each from 0 (useless) to 100; None where it cannot be determined.

    Attributes:
        overall: geometric mean of both parts, geometry with three quarters of the weight; geometry
            alone where labels cannot be determined.
        labels: of P(static); None where hardly anything moves.
        geometry: of poses and map.
        evidence: see QualityEvidence; unknown of results that were read from a folder.
    """

    overall: float | None = None
    labels: float | None = None
    geometry: float | None = None
    evidence: QualityEvidence = field(default_factory=QualityEvidence, compare=False, repr=False)


def rate_quality(
    deskewed: Recording, poses: Float, p_static: Float32, occupancy: OccupancyMap, threads: int = 1
) -> Quality:
    """Rates labels, poses and map of any estimator by the same evidence.

    Args:
        deskewed: 2D or 3D.
        poses: (T, D+1, D+1) T_map_base.
        p_static: (M,) P(c = 1).
        occupancy: the map of what is static.
        threads: does not change the result.
    """
    if deskewed.n_scans < 2:
        return Quality()
    counts, apart = [], list[float]()
    for window in rematching.rematch_windows(deskewed, poses, threads):
        disagreement = window.disagreement()
        apart += [] if disagreement is None else [disagreement]
        for part in window.split(_JUDGED_SCANS):
            of_part = p_static[part.beams]
            candidates = _candidates(part)
            counts.append(final_labels.count_expected(part.recording, candidates, of_part, threads))
    evidence = replace(
        _measure_geometry(deskewed, poses, occupancy),
        expected_f1=final_labels.expected_f1(counts),
        disagreement=float(np.median(apart)) if apart else None,
    )
    return _grade(evidence, deskewed.dimension)


def rate_geometry(deskewed: Recording, poses: Float, occupancy: OccupancyMap) -> Quality:
    """Rates poses and map alone, of scans too far apart to be matched anew or to judge labels by.

    Args:
        deskewed, poses, occupancy: see `rate_quality`.
    """
    return _grade(_measure_geometry(deskewed, poses, occupancy), deskewed.dimension)


def _measure_geometry(
    deskewed: Recording, poses: Float, occupancy: OccupancyMap
) -> QualityEvidence:
    """The evidence of surfaces seen again and of small pieces of the map."""
    return QualityEvidence(
        displacement=surface_agreement.mean_displacement(deskewed, poses),
        small_pieces=count_small_pieces(occupancy),
    )


def _candidates(part: rematching.Window) -> list[Float]:
    """Poses of a window at which labels are judged."""
    if part.rematched is None:
        return [part.poses]
    # in 3D the given poses add nothing to the new ones, which are accurate
    return [part.rematched] if part.recording.dimension == 3 else [part.poses, part.rematched]


def _grade(evidence: QualityEvidence, dimension: int) -> Quality:
    """The figures that follow from the evidence, rounded to a tenth."""
    geometry = overall = None
    labels = None if evidence.expected_f1 is None else _to_percent(evidence.expected_f1, _BEST_F1)
    if evidence.small_pieces is not None:
        disagreement, displacement, small_pieces, unseen = _SCALE[dimension]
        apart = unseen if evidence.displacement is None else evidence.displacement
        parts = [apart / displacement, evidence.small_pieces / small_pieces]
        if evidence.disagreement is not None:
            parts.append(evidence.disagreement / disagreement)
        mean = float(np.prod([1.0 / (1.0 + part) for part in parts])) ** (1.0 / len(parts))
        geometry = _to_percent(mean, _BEST_GEOMETRY)
    if labels is None:
        overall = geometry
    elif geometry is not None:
        overall = labels ** (1.0 - _GEOMETRY_WEIGHT) * geometry**_GEOMETRY_WEIGHT
    return Quality(_round(overall), _round(labels), _round(geometry), evidence)


def _to_percent(share: float, best: float) -> float:
    return 100.0 * min(share / best, 1.0)


def _round(value: float | None) -> float | None:
    return None if value is None else round(value, 1)


# the verdict on overall is at most that of the lower part plus this: no good map with poor labels
_MAX_CONTRAST = 25.0

_VERDICTS = {
    80.0: "good",
    60.0: "usable",
    40.0: "check the map before use",
    0.0: "doubtful",
}
_MEANINGS = {
    "overall": "both, of which geometry counts more",
    "labels": "how far a second estimate agrees about what moved",
    "geometry": "how far scans matched anew and surfaces observed again agree with the map",
}


def describe_quality(quality: Quality) -> dict[str, str]:
    """One line for each part, for readers who do not know how it is computed."""
    out = {}
    for part, meaning in _MEANINGS.items():
        value = getattr(quality, part)
        if value is None:
            out[part] = f"{part}: cannot be determined from this recording"
            continue
        parts = [one for one in (quality.labels, quality.geometry) if one is not None]
        judged = min(value, min(parts) + _MAX_CONTRAST) if part == "overall" else value
        verdict = next(word for lowest, word in _VERDICTS.items() if judged >= lowest)
        out[part] = f"{part} {value:.0f} of 100: {verdict} ({meaning})"
    return out
