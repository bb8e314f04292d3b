"""How people are found and tracked."""

from dataclasses import dataclass

from stillmap.options import field_with_doc


@dataclass(frozen=True)
class TrackerOptions:
    """The tracking estimator; `docs/tracker.md` says how it works."""

    jump: float = field_with_doc(0.3, "m of range between neighbouring beams: a feature's edge")
    narrowest: float = field_with_doc(0.05, "m, width of a leg at least")
    widest: float = field_with_doc(0.65, "m, width of a body at most")
    sigma: float = field_with_doc(0.1, "m, a feature beside the middle of its person: legs swing")
    sigma_speed: float = field_with_doc(1.0, "m/s, how fast people are when first seen")
    acceleration: float = field_with_doc(0.5, "m2/s3, density of random acceleration")
    gate: float = field_with_doc(2.5, "standard deviations within which features may be a person's")
    detection: float = field_with_doc(0.9, "probability that a person in sight shows a feature")
    clutter: float = field_with_doc(0.05, "features per m2 that are of nobody tracked")
    lost: float = field_with_doc(1.0, "s without a feature after which a track ends")
    moved: float = field_with_doc(0.5, "m from where it began: such a track is a person's")
    look: float = field_with_doc(2.0, "s between scans in which a person has left its place")
    changed: float = field_with_doc(
        0.2, "share of a person's features at least that stand where shortly there was nothing"
    )
    least: int = field_with_doc(4, "scans with a feature that a person's track has at least")
    box: float = field_with_doc(0.4, "m to each side of a person, in which beams are dropped")

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'em.tracker.{name}' wants {low:g} to {high:g}")


_LIMITS = (
    ("jump", 1e-3, 100.0),
    ("narrowest", 0.0, 100.0),
    ("widest", 0.0, 100.0),
    ("sigma", 1e-3, 100.0),
    ("sigma_speed", 1e-3, 1000.0),
    ("acceleration", 1e-6, 1e6),
    ("gate", 0.1, 100.0),
    ("detection", 0.01, 0.9999),
    ("clutter", 1e-9, 1e3),
    ("lost", 0.0, 1e6),
    ("moved", 0.0, 1000.0),
    ("look", 0.0, 1e6),
    ("changed", 0.0, 1.0),
    ("least", 1, 1_000_000),
    ("box", 0.0, 100.0),
)
