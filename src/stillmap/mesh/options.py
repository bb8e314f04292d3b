"""How models are made.

How surfaces are built.

How pictures are put on a surface.

How pictures are put onto a mesh.
"""

from dataclasses import dataclass, field

from stillmap.core.config import option

_EXACT, _SHARE = 0.01, 0.25  # m, and of a voxel's edge, that a surface may be moved by


@dataclass(frozen=True)
class SurfaceOptions:
    """The surface of what stands still; `docs/mesh.md` says how it is made."""

    voxel: float | None = option(None, "m, edge of a voxel; not set: by how far beams lie apart")
    before: float = option(3.0, "voxels in front of a surface in which it is known")
    behind: float = option(2.0, "voxels behind it, likewise")
    least: float = option(0.5, "P(static) that a triangle needs, of its beams together")
    longest: float = option(1.5, "m, longer edges of triangles span holes")
    longest_share: float = option(0.15, "of the range, likewise")
    widest: float = option(
        3.0, "times as far apart as usual are beams between which there are holes"
    )
    steepest: float = option(1.5, "rad between the line of sight and a surface's normal")
    steep: float = option(1.22, "rad, steeper triangles must lie in a plane with those beside")
    bend: float = option(0.35, "rad between such a triangle's normal and those beside")
    pause: float = option(1.0, "s without a scan after which rows are not neighbours")
    apart: float = option(
        0.2, "of the usual range, by which the sensor goes on until a scan tells something new"
    )
    turned: float = option(0.1, "rad by which it turns, likewise")
    looks: int = option(2, "scans from one place that are used")
    fewest: float = option(0.0, "triangles that a voxel must be of, by their weights")
    island: float = option(0.05, "m2, smaller pieces are left out")
    error: float | None = option(
        None, "m that thinning out may move the surface by; not set: by the voxel's edge"
    )
    faces: int = option(200_000, "triangles at most, whatever the error")

    def __post_init__(self) -> None:
        for name, low, high in _SURFACE_LIMITS:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"'mesh.surface.{name}' wants {low:g} to {high:g}")

    def error_for(self, voxel: float) -> float:
        """Metres that thinning out may move a surface by of voxels with this edge in metres."""
        return max(_EXACT, _SHARE * voxel) if self.error is None else self.error


_SURFACE_LIMITS = (
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


@dataclass(frozen=True)
class ChoiceOptions:
    """Which picture paints which face; docs/mesh.md says how it is chosen."""

    believe: bool = option(
        True, "ask what the lasers saw to move; without, the sharpest picture paints each face"
    )
    margin: float = option(0.05, "m around what was seen of a thing that moves")
    sigma: float = option(0.05, "m, by how much its outline may be off beyond that")
    hold: float = option(
        0.5, "s for which a thing goes on before it is first seen and after it is last"
    )
    window: float = option(0.06, "s around a picture, beams within which tell of it")
    rows: float = option(
        0.15, "the same where scans lie in a plane, as those of a laser that tilts"
    )
    carried: float = option(
        0.5, "the same, there, of beams on things that are followed: they go on with these"
    )
    unseen: float = option(
        0.9, "probability that a picture shows what stands still where no beam tells of it"
    )
    least: float = option(
        0.6, "probability below which a picture does not paint a face, if need be none does"
    )
    trust: float = option(
        10.0, "what the logarithm of that probability counts against that of the resolution"
    )
    odd: float = option(
        40.0, "by which a colour, of 442, differs from those of most other pictures; 0: not asked"
    )
    level: bool = option(
        True, "brighten pictures, each of its three colours, until they agree with one another"
    )
    border: float = option(
        1.0, "what it costs where two pictures meet, in e-folds of resolution of the faces there"
    )
    candidates: int = option(6, "pictures that are compared for each face, the best ones")
    edge: float = option(
        0.25, "m, longer edges of faces are divided first: each part has its own picture"
    )
    edge_pixels: float = option(
        16.0, "pixels, edges that are shorter in the nearest picture are not divided"
    )

    def __post_init__(self) -> None:
        for name in ("unseen", "least"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"'mesh.choice.{name}' wants a probability")
        for name, low, high in _VIEW_LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'mesh.choice.{name}' wants {low:g} to {high:g}")


_VIEW_LIMITS = (
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


@dataclass(frozen=True)
class VisibleOptions:
    """Which faces a picture shows."""

    scale: float = option(
        0.5, "pixels per pixel of the picture, along an edge, in which it is seen what hides what"
    )
    near: float = option(0.05, "m ahead of a camera, nothing before is seen")
    margin: float = option(2.0, "pixels by which a face lies within a picture's edges")
    cosine: float = option(0.03, "least cosine between a face's normal and the line of sight")
    pixels: float = option(0.25, "least area of a face in a picture, square pixels")
    tolerance: float = option(0.01, "m by which a face may lie behind what hides it")
    relative: float = option(0.005, "the same, more, per metre of distance")
    steepest: float = option(
        0.05, "the same, for slanting faces, at most, per metre of distance; beside them twice that"
    )
    beside: int = option(
        1, "pixels of the scaled picture: what is much nearer so close beside a face hides it, too"
    )
    spacing: float = option(
        8.0, "pixels of the scaled picture between places of a large face that are looked at"
    )
    inwards: float = option(
        0.2, "share of the way to the middle by which corners are pulled in to look at them"
    )

    def __post_init__(self) -> None:
        for name, low, high in (
            ("scale", 0.05, 2.0),
            ("near", 1e-4, 100.0),
            ("margin", 0.0, 1000.0),
            ("cosine", 0.0, 0.999),
            ("pixels", 0.0, 1e9),
            ("tolerance", 0.0, 100.0),
            ("relative", 0.0, 1.0),
            ("steepest", 0.0, 10.0),
            ("beside", 0, 16),
            ("spacing", 1.0, 1e4),
            ("inwards", 0.0, 0.9),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'mesh.texture.visible.{name}' wants {low} to {high}")


@dataclass(frozen=True)
class TextureOptions:
    """Colours of a mesh from pictures."""

    page: int = option(4096, "texels along the edge of a page of texture, at most")
    pages: int = option(8, "pages at most; where they would be more, texels are coarser")
    texel: float = option(0.001, "m, edge of a texel where pictures are finer than that")
    gutter: int = option(4, "texels around each piece of texture that get its colours")
    quality: int = option(90, "of pages as JPEG, up to 95; 0: PNG, without loss")
    visible: VisibleOptions = field(default_factory=VisibleOptions)

    def __post_init__(self) -> None:
        for name, low, high in (
            ("page", 64, 16384),
            ("pages", 1, 1000),
            ("texel", 1e-5, 100.0),
            ("gutter", 1, 16),
            ("quality", 0, 95),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'mesh.texture.{name}' wants {low} to {high}")


@dataclass(frozen=True)
class MoverOptions:
    """Models of what moved."""

    enabled: bool = option(True, "make models of what moved")
    voxel: float | None = option(
        None, "m, edge of a voxel of their surfaces; not set: by how far beams lie apart on them"
    )
    margin: float = option(0.15, "m around a thing's box, within which beams are its own")
    low: float = option(0.03, "m above the ground: what is lower is the ground's")
    rigid: float = option(
        1.2, "m, things at least so long or wide are no people, and keep their shape"
    )
    together: float = option(
        0.5, "s before and after the best look at these, from which all looks are put together"
    )
    blurred: float = option(
        0.05, "m, looks that lie farther off the best one are left out; most: it counts alone"
    )
    fast: float = option(
        2.0, "m/s, what is faster is no person: what moves and hangs together with it is its own"
    )
    link: float = option(0.5, "m between parts of such a thing")
    sweep: float = option(
        0.4, "s, in which a laser that tilts sees a thing: so long others keep their shape"
    )
    stretch: float = option(
        2.5, "times as far apart as usual are beams on them between which there is no surface"
    )
    longest: float = option(0.6, "m, or farther apart than that")
    near: float = option(
        0.5, "s from then to a picture that paints a thing that does not keep its shape"
    )
    rim: float = option(
        0.01, "m within a thing's outline in a picture, where it may show what is behind"
    )
    drift: float = option(
        0.05, "of the way it went from then to the picture, by which the outline may be off, too"
    )
    differs: float = option(
        30.0, "by which colours differ from those of the place behind, of 442; 0: not asked for"
    )
    unsure: float = option(
        0.05, "m more than `rim` within the outline, where nobody knows what is behind"
    )
    edge: float = option(0.05, "m, longer edges are divided before they are painted")
    least: float = option(0.01, "m2 of surface that a model has")
    height: float = option(
        0.05, "m from its lowest to its highest point, at least: what is flatter is the ground's"
    )
    dynamic: float = option(
        0.7,
        "P(dynamic) of what ended at it when it was seen, on average, at least: what is less "
        "stands still; 0: not asked for",
    )
    about: float = option(0.2, "m from its surface, up to where beams ended at it")
    island: float = option(0.005, "m2, smaller pieces of it are left out")

    def __post_init__(self) -> None:
        for name, low, high in _OBJECT_LIMITS:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"'mesh.objects.{name}' wants {low:g} to {high:g}")


_OBJECT_LIMITS = (
    ("voxel", 1e-3, 10.0),
    ("margin", 0.0, 10.0),
    ("low", -10.0, 10.0),
    ("rigid", 0.0, 1000.0),
    ("together", 0.0, 10.0),
    ("blurred", 0.0, 1000.0),
    ("link", 0.0, 1000.0),
    ("fast", 0.0, 1000.0),
    ("sweep", 1e-3, 1000.0),
    ("stretch", 1.0, 1000.0),
    ("longest", 0.0, 1000.0),
    ("near", 0.0, 1000.0),
    ("rim", 0.0, 10.0),
    ("drift", 0.0, 100.0),
    ("unsure", 0.0, 1000.0),
    ("differs", 0.0, 442.0),
    ("edge", 0.005, 1000.0),
    ("least", 0.0, 1000.0),
    ("height", 0.0, 1000.0),
    ("dynamic", 0.0, 1.0),
    ("about", 0.02, 10.0),
    ("island", 0.0, 1000.0),
)


@dataclass(frozen=True)
class PointOptions:
    """Colours of the points of clouds."""

    enabled: bool = option(True, "take them from pictures, where there are any")
    off: float = option(0.1, "m off the surface of the place, up to which a point has its colour")
    rim: float = option(
        0.02, "m within what a thing's points cover in a picture, where it may show what is behind"
    )
    apart: float = option(0.12, "m around each of its points that a thing covers")

    def __post_init__(self) -> None:
        for name, low, high in (("off", 1e-3, 10.0), ("rim", 0.0, 10.0), ("apart", 1e-3, 10.0)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'mesh.points.{name}' wants {low:g} to {high:g}")


@dataclass(frozen=True)
class MeshOptions:
    """Models of recordings in 3D: of the place, and of what moved; docs/mesh.md."""

    enabled: bool = option(True, "make them, where the libraries of the extra `mesh` are")
    surface: SurfaceOptions = field(default=SurfaceOptions())
    choice: ChoiceOptions = field(default=ChoiceOptions())
    texture: TextureOptions = field(default=TextureOptions())
    objects: MoverOptions = field(default=MoverOptions())
    points: PointOptions = field(default=PointOptions())
