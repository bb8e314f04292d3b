"""How surfaces are built."""

from dataclasses import dataclass

from stillmap.options import field_with_doc

_EXACT, _SHARE = 0.01, 0.25  # m, and of a voxel's edge, that a surface may be moved by


@dataclass(frozen=True)
class SurfaceOptions:
    """The surface of what stands still; `docs/mesh.md` says how it is made."""

    voxel: float | None = field_with_doc(
        None, "m, edge of a voxel; not set: by how far beams lie apart"
    )
    before: float = field_with_doc(3.0, "voxels in front of a surface in which it is known")
    behind: float = field_with_doc(2.0, "voxels behind it, likewise")
    least: float = field_with_doc(0.5, "P(static) that a triangle needs, of its beams together")
    longest: float = field_with_doc(1.5, "m, longer edges of triangles span holes")
    longest_share: float = field_with_doc(0.15, "of the range, likewise")
    widest: float = field_with_doc(
        3.0, "times as far apart as usual are beams between which there are holes"
    )
    steepest: float = field_with_doc(1.5, "rad between the line of sight and a surface's normal")
    steep: float = field_with_doc(
        1.22, "rad, steeper triangles must lie in a plane with those beside"
    )
    bend: float = field_with_doc(0.35, "rad between such a triangle's normal and those beside")
    pause: float = field_with_doc(1.0, "s without a scan after which rows are not neighbours")
    apart: float = field_with_doc(
        0.2, "of the usual range, by which the sensor goes on until a scan tells something new"
    )
    turned: float = field_with_doc(0.1, "rad by which it turns, likewise")
    looks: int = field_with_doc(2, "scans from one place that are used")
    fewest: float = field_with_doc(0.0, "triangles that a voxel must be of, by their weights")
    island: float = field_with_doc(0.05, "m2, smaller pieces are left out")
    error: float | None = field_with_doc(
        None, "m that thinning out may move the surface by; not set: by the voxel's edge"
    )
    faces: int = field_with_doc(200_000, "triangles at most, whatever the error")

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"'mesh.surface.{name}' wants {low:g} to {high:g}")

    def error_for(self, voxel: float) -> float:
        """Metres that thinning out may move a surface by of voxels with this edge in metres."""
        return max(_EXACT, _SHARE * voxel) if self.error is None else self.error


_LIMITS = (
    ("voxel", 1e-3, 10.0),
    ("before", 1.0, 60.0),
    ("behind", 1.0, 60.0),
    ("least", 0.0, 1.0),
    ("longest", 0.0, 1000.0),
    ("longest_share", 0.0, 10.0),
    ("widest", 1.0, 1000.0),
    ("steepest", 0.0, 1.57),
    ("steep", 0.0, 1.58),
    ("bend", 0.0, 3.2),
    ("pause", 0.0, 1e6),
    ("apart", 0.0, 100.0),
    ("turned", 0.0, 10.0),
    ("looks", 1, 1_000_000),
    ("fewest", 0.0, 1e9),
    ("island", 0.0, 1e6),
    ("error", 0.0, 1.0),
    ("faces", 4, 1_000_000_000),
)
