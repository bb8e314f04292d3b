"""What the writers need of models: the dataclasses of `stillmap.models` satisfy these by their
shape."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stillmap.mesh.texture.atlas import Textured


class MeshLike(Protocol):
    """Triangles: vertices (V, 3) float64 metres, faces (F, 3) int32."""

    @property
    def vertices(self) -> NDArray[np.float64]: ...
    @property
    def faces(self) -> NDArray[np.int32]: ...
    def areas(self) -> NDArray[np.float64]: ...


class ViewLike(Protocol):
    """A picture, by its number, and from where it was taken: T_camera_map (4, 4)."""

    @property
    def image(self) -> int: ...
    @property
    def T_camera_map(self) -> NDArray[np.float64]: ...


class PaintedLike(Protocol):
    """A surface of F faces, and what paints each; see `stillmap.models.place.Painted`."""

    @property
    def mesh(self) -> MeshLike: ...
    @property
    def view(self) -> NDArray[np.int32]: ...
    @property
    def p_static(self) -> NDArray[np.float32]: ...
    @property
    def seen(self) -> NDArray[np.bool_]: ...
    @property
    def sharpest(self) -> NDArray[np.int32]: ...
    @property
    def p_sharpest(self) -> NDArray[np.float32]: ...


class ShapeLike(Protocol):
    """The surface of a thing that moved: of which object, and whether it kept its shape."""

    @property
    def id(self) -> int: ...
    @property
    def rigid(self) -> bool: ...


class DressedLike(Protocol):
    """A moving thing's surface and what paints it."""

    @property
    def painted(self) -> PaintedLike: ...
    @property
    def views(self) -> Sequence[ViewLike]: ...


class MoverModelLike(Protocol):
    """What moved, as a model; see `stillmap.models.building.MoverModel`."""

    @property
    def shape(self) -> ShapeLike: ...
    @property
    def dressed(self) -> DressedLike: ...
    @property
    def textured(self) -> Textured: ...
    @property
    def T_map_object(self) -> NDArray[np.float64]: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def span_ns(self) -> tuple[int, int]: ...


class TintsLike(Protocol):
    """Colours of the beams' ends; see `stillmap.models.tinting.Tints`."""

    @property
    def colours(self) -> NDArray[np.uint8]: ...
    @property
    def counts(self) -> Mapping[str, int]: ...


class ModelsLike(Protocol):
    """Models of the place and of what moved; see `stillmap.models.building.Models`."""

    @property
    def painted(self) -> PaintedLike: ...
    @property
    def textured(self) -> Textured: ...
    @property
    def unfiltered(self) -> Textured | None: ...
    @property
    def views(self) -> Sequence[ViewLike]: ...
    @property
    def left_out(self) -> Mapping[str, int]: ...
    @property
    def unread(self) -> Sequence[str]: ...
    @property
    def movers(self) -> Sequence[MoverModelLike]: ...
    @property
    def tried(self) -> int: ...
    @property
    def tints(self) -> TintsLike | None: ...
