"""How moving things are found."""

from dataclasses import dataclass

from stillmap.core.config import option


@dataclass(frozen=True)
class ObjectOptions:
    """What moved; `docs/objects.md` says how it is found."""

    enabled: bool = option(True, "find what moved, and follow it")
    dynamic: float = option(0.7, "a beam is of something that moves if it is so probable at least")
    link: float = option(0.35, "m between neighbouring end points on one thing")
    link_slope: float = option(0.02, "m more for each metre of range")
    near: float = option(0.2, "m from where a thing was expected, at most")
    near_sigmas: float = option(2.0, "standard deviations of that in addition")
    far: float = option(0.35, "m, the same for a thing that is nowhere else")
    farthest: float = option(1.2, "m, whatever the standard deviations")
    apart: float = option(0.7, "m between parts that are two things")
    shape: float = option(0.6, "s for which what was seen of a thing is its shape")
    gap: float = option(2.0, "s that a thing may be hidden")
    gap_between: float = option(
        3.0, "s that it may be hidden where its ways before and after fit together"
    )
    sigma: float = option(0.12, "m by which the middle of what is seen of a thing is off")
    sigma_way: float = option(
        0.28, "m, the same where ways are smoothed: legs swing to and fro in time"
    )
    sigma_speed: float = option(1.0, "m/s, how fast things are when first seen")
    acceleration: float = option(1.0, "m2/s3, density of random acceleration")
    beside: float = option(0.55, "m between two things that always go together: one thing")
    least_scans: int = option(4, "scans that a thing must be seen in")
    least_seconds: float = option(0.6, "s from when it is first seen to when it is last")
    least_extent: float = option(
        0.15, "m that it went and is long: an edge that flickers stays, and has no size"
    )

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'objects.{name}' wants {low:g} to {high:g}")


_LIMITS = (
    ("dynamic", 0.0, 1.0),
    ("link", 0.0, 100.0),
    ("link_slope", 0.0, 1.0),
    ("near", 0.0, 100.0),
    ("near_sigmas", 0.0, 100.0),
    ("far", 0.0, 100.0),
    ("farthest", 0.0, 1000.0),
    ("apart", 0.0, 100.0),
    ("shape", 0.0, 100.0),
    ("gap", 0.0, 1000.0),
    ("gap_between", 0.0, 1000.0),
    ("sigma", 1e-3, 100.0),
    ("sigma_way", 1e-3, 100.0),
    ("sigma_speed", 1e-3, 1000.0),
    ("acceleration", 1e-6, 1e6),
    ("beside", 0.0, 100.0),
    ("least_scans", 1, 1_000_000),
    ("least_seconds", 0.0, 1e6),
    ("least_extent", 0.0, 1000.0),
)
