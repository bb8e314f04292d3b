"""How pictures are put onto a mesh."""

from dataclasses import dataclass, field

from stillmap.options import field_with_doc


@dataclass(frozen=True)
class VisibleOptions:
    """Which faces a picture shows."""

    scale: float = field_with_doc(
        0.5, "pixels per pixel of the picture, along an edge, in which it is seen what hides what"
    )
    near: float = field_with_doc(0.05, "m ahead of a camera, nothing before is seen")
    margin: float = field_with_doc(2.0, "pixels by which a face lies within a picture's edges")
    cosine: float = field_with_doc(
        0.03, "least cosine between a face's normal and the line of sight"
    )
    pixels: float = field_with_doc(0.25, "least area of a face in a picture, square pixels")
    tolerance: float = field_with_doc(0.01, "m by which a face may lie behind what hides it")
    relative: float = field_with_doc(0.005, "the same, more, per metre of distance")
    steepest: float = field_with_doc(
        0.05, "the same, for slanting faces, at most, per metre of distance; beside them twice that"
    )
    beside: int = field_with_doc(
        1, "pixels of the scaled picture: what is much nearer so close beside a face hides it, too"
    )
    spacing: float = field_with_doc(
        8.0, "pixels of the scaled picture between places of a large face that are looked at"
    )
    inwards: float = field_with_doc(
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

    page: int = field_with_doc(4096, "texels along the edge of a page of texture, at most")
    pages: int = field_with_doc(8, "pages at most; where they would be more, texels are coarser")
    texel: float = field_with_doc(0.001, "m, edge of a texel where pictures are finer than that")
    gutter: int = field_with_doc(4, "texels around each piece of texture that get its colours")
    quality: int = field_with_doc(90, "of pages as JPEG, up to 95; 0: PNG, without loss")
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
