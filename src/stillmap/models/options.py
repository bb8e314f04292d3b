"""How models are made."""

from dataclasses import dataclass, field

from stillmap.options import field_with_doc
from stillmap.surface.options import SurfaceOptions
from stillmap.texture.choice_options import ChoiceOptions
from stillmap.texture.options import TextureOptions


@dataclass(frozen=True)
class MoverOptions:
    """Models of what moved."""

    enabled: bool = field_with_doc(True, "make models of what moved")
    voxel: float | None = field_with_doc(
        None, "m, edge of a voxel of their surfaces; not set: by how far beams lie apart on them"
    )
    margin: float = field_with_doc(0.15, "m around a thing's box, within which beams are its own")
    low: float = field_with_doc(0.03, "m above the ground: what is lower is the ground's")
    rigid: float = field_with_doc(
        1.2, "m, things at least so long or wide are no people, and keep their shape"
    )
    together: float = field_with_doc(
        0.5, "s before and after the best look at these, from which all looks are put together"
    )
    blurred: float = field_with_doc(
        0.05, "m, looks that lie farther off the best one are left out; most: it counts alone"
    )
    fast: float = field_with_doc(
        2.0, "m/s, what is faster is no person: what moves and hangs together with it is its own"
    )
    link: float = field_with_doc(0.5, "m between parts of such a thing")
    sweep: float = field_with_doc(
        0.4, "s, in which a laser that tilts sees a thing: so long others keep their shape"
    )
    stretch: float = field_with_doc(
        2.5, "times as far apart as usual are beams on them between which there is no surface"
    )
    longest: float = field_with_doc(0.6, "m, or farther apart than that")
    near: float = field_with_doc(
        0.5, "s from then to a picture that paints a thing that does not keep its shape"
    )
    rim: float = field_with_doc(
        0.01, "m within a thing's outline in a picture, where it may show what is behind"
    )
    drift: float = field_with_doc(
        0.05, "of the way it went from then to the picture, by which the outline may be off, too"
    )
    differs: float = field_with_doc(
        30.0, "by which colours differ from those of the place behind, of 442; 0: not asked for"
    )
    unsure: float = field_with_doc(
        0.05, "m more than `rim` within the outline, where nobody knows what is behind"
    )
    edge: float = field_with_doc(0.05, "m, longer edges are divided before they are painted")
    least: float = field_with_doc(0.01, "m2 of surface that a model has")
    height: float = field_with_doc(
        0.05, "m from its lowest to its highest point, at least: what is flatter is the ground's"
    )
    dynamic: float = field_with_doc(
        0.7,
        "P(dynamic) of what ended at it when it was seen, on average, at least: what is less "
        "stands still; 0: not asked for",
    )
    about: float = field_with_doc(0.2, "m from its surface, up to where beams ended at it")
    island: float = field_with_doc(0.005, "m2, smaller pieces of it are left out")

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"'mesh.objects.{name}' wants {low:g} to {high:g}")


_LIMITS = (
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

    enabled: bool = field_with_doc(True, "take them from pictures, where there are any")
    off: float = field_with_doc(
        0.1, "m off the surface of the place, up to which a point has its colour"
    )
    rim: float = field_with_doc(
        0.02, "m within what a thing's points cover in a picture, where it may show what is behind"
    )
    apart: float = field_with_doc(0.12, "m around each of its points that a thing covers")

    def __post_init__(self) -> None:
        for name, low, high in (("off", 1e-3, 10.0), ("rim", 0.0, 10.0), ("apart", 1e-3, 10.0)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'mesh.points.{name}' wants {low:g} to {high:g}")


@dataclass(frozen=True)
class MeshOptions:
    """Models of recordings in 3D: of the place, and of what moved; docs/mesh.md."""

    enabled: bool = field_with_doc(True, "make them, where the libraries of the extra `mesh` are")
    surface: SurfaceOptions = field(default=SurfaceOptions())
    choice: ChoiceOptions = field(default=ChoiceOptions())
    texture: TextureOptions = field(default=TextureOptions())
    objects: MoverOptions = field(default=MoverOptions())
    points: PointOptions = field(default=PointOptions())
