"""A mesh with pictures on it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import _core

Float = NDArray[np.float64]
Index = NDArray[np.int32]
Picture = NDArray[np.uint8]

GREY = (128, 128, 128)  # what no picture shows


@dataclass(frozen=True, eq=False)
class Textured:
    """F faces over U vertices, and P pages of texels.

    Where pieces of the texture meet, vertices stand there once for each piece.

    Attributes:
        vertices: (U, 3) float64 metres.
        faces: (F, 3) int32, in the order of the mesh they were made from.
        uv: (U, 2) float64, share of the page's width from the left and of its height from the top;
            0 where no page is used.
        page: (F,) int32, -1: grey.
        pages: P pictures (h, w, 3) uint8, as photographed (sRGB).
        view: (F,) int32, which view's picture is on each face, -1: none.
        vertex: (U,) int32, of the mesh it was made from; -1: it was not.
        unread: one line for each picture that could not be read; its faces are painted grey.
    """

    vertices: Float
    faces: Index
    uv: Float
    page: Index
    pages: tuple[Picture, ...]
    view: Index
    vertex: Index
    unread: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.faces)

    def face_of_texel(self, page: int) -> Index:
        """(h, w) int32, which face each texel of a page is of; -1: of none, but beside one."""
        h, w = self.pages[page].shape[:2]
        out = np.full(h * w, -1, np.int32)
        mine = np.flatnonzero(self.page == page)
        corners = self.uv[self.faces[mine]] * np.array([w, h], float)
        texel, of, _ = _core.texels(corners, w, h)
        out[texel] = mine[of]
        return out.reshape(h, w)


def replaced(whole: Textured, of: NDArray[np.bool_], part: Textured) -> Textured:
    """A mesh some of whose faces are painted otherwise.

    Args:
        whole: F faces.
        of: (F,) which of them are those of `part`, in their order.
        part: as many faces as `of` names.
    """
    if of.shape != (len(whole),) or np.count_nonzero(of) != len(part):
        raise ValueError(f"of: expected ({len(whole)},) with {len(part)} faces")
    faces, page, view = whole.faces.copy(), whole.page.copy(), whole.view.copy()
    faces[of] = part.faces + np.int32(len(whole.vertices))
    page[of] = np.where(part.page >= 0, part.page + np.int32(len(whole.pages)), part.page)
    view[of] = part.view
    return Textured(
        np.concatenate([whole.vertices, part.vertices]),
        faces,
        np.concatenate([whole.uv, part.uv]),
        page,
        (*whole.pages, *part.pages),
        view,
        np.concatenate([whole.vertex, np.full(len(part.vertices), -1, np.int32)]),
        (*whole.unread, *part.unread),
    )
