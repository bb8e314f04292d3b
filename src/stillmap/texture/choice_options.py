"""How pictures are put on a surface."""

from dataclasses import dataclass

from stillmap.options import field_with_doc


@dataclass(frozen=True)
class ChoiceOptions:
    """Which picture paints which face; docs/mesh.md says how it is chosen."""

    believe: bool = field_with_doc(
        True, "ask what the lasers saw to move; without, the sharpest picture paints each face"
    )
    margin: float = field_with_doc(0.05, "m around what was seen of a thing that moves")
    sigma: float = field_with_doc(0.05, "m, by how much its outline may be off beyond that")
    hold: float = field_with_doc(
        0.5, "s for which a thing goes on before it is first seen and after it is last"
    )
    window: float = field_with_doc(0.06, "s around a picture, beams within which tell of it")
    rows: float = field_with_doc(
        0.15, "the same where scans lie in a plane, as those of a laser that tilts"
    )
    carried: float = field_with_doc(
        0.5, "the same, there, of beams on things that are followed: they go on with these"
    )
    unseen: float = field_with_doc(
        0.9, "probability that a picture shows what stands still where no beam tells of it"
    )
    least: float = field_with_doc(
        0.6, "probability below which a picture does not paint a face, if need be none does"
    )
    trust: float = field_with_doc(
        10.0, "what the logarithm of that probability counts against that of the resolution"
    )
    odd: float = field_with_doc(
        40.0, "by which a colour, of 442, differs from those of most other pictures; 0: not asked"
    )
    level: bool = field_with_doc(
        True, "brighten pictures, each of its three colours, until they agree with one another"
    )
    border: float = field_with_doc(
        1.0, "what it costs where two pictures meet, in e-folds of resolution of the faces there"
    )
    candidates: int = field_with_doc(6, "pictures that are compared for each face, the best ones")
    edge: float = field_with_doc(
        0.25, "m, longer edges of faces are divided first: each part has its own picture"
    )
    edge_pixels: float = field_with_doc(
        16.0, "pixels, edges that are shorter in the nearest picture are not divided"
    )

    def __post_init__(self) -> None:
        for name in ("unseen", "least"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"'mesh.choice.{name}' wants a probability")
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'mesh.choice.{name}' wants {low:g} to {high:g}")


_LIMITS = (
    ("margin", 0.0, 10.0),
    ("sigma", 1e-3, 10.0),
    ("hold", 0.0, 1000.0),
    ("window", 1e-3, 1000.0),
    ("rows", 1e-3, 1000.0),
    ("carried", 0.0, 1000.0),
    ("trust", 0.0, 1e6),
    ("odd", 0.0, 442.0),
    ("border", 0.0, 1e6),
    ("candidates", 1, 64),
    ("edge", 0.01, 1000.0),
    ("edge_pixels", 0.0, 1e6),
)
