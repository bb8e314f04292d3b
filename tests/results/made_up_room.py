"""A textured room of 6 x 4 x 3 m, seen from inside, with or without somebody on a wall."""

import numpy as np

from stillmap.mesh.texture.atlas import TexturedMesh

SIZE = (6.0, 4.0, 3.0)


def quad(corners, page):
    """Two faces of four corners, lower left, lower right, upper right, upper left as seen, with the
    whole of a page on them."""
    at = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)
    return np.array(corners, float), at, page


def together(quads, pages):
    n = len(quads)
    square = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    page = np.repeat([one for *_, one in quads], 2).astype(np.int32)
    return TexturedMesh(
        vertices=np.concatenate([corners for corners, *_ in quads]),
        faces=np.concatenate([square + 4 * k for k in range(n)]).astype(np.int32),
        uv=np.concatenate([at for _, at, _ in quads]),
        page=page,
        pages=tuple(pages),
        view=page,
    )


def wall_page(colour, person=False):
    """A page of 64 x 96: a colour that grows lighter upwards, and perhaps a person in magenta."""
    page = np.empty((64, 96, 3), np.uint8)
    page[:] = np.array(colour) * np.linspace(1.0, 0.5, 64)[:, None, None]
    if person:
        page[20:, 40:56] = (220, 0, 200)
    return page


def room(person=False):
    """Walls facing +x, +y, -x, -y in four colours, the second with the person; floor and ceiling
    without a picture. The middle of the floor is at (0, 0, 0)."""
    a, b, h = SIZE[0] / 2, SIZE[1] / 2, SIZE[2]
    colours = [(230, 60, 40), (60, 200, 60), (60, 90, 230), (230, 200, 60)]
    ring = [(-a, -b), (-a, b), (a, b), (a, -b)]
    quads = []
    for n in range(4):
        (x0, y0), (x1, y1) = ring[n], ring[(n + 1) % 4]
        quads.append(quad([(x0, y0, 0), (x1, y1, 0), (x1, y1, h), (x0, y0, h)], n))
    quads.append(quad([(-a, -b, 0), (a, -b, 0), (a, b, 0), (-a, b, 0)], -1))
    quads.append(quad([(-a, b, h), (a, b, h), (a, -b, h), (-a, -b, h)], -1))
    pages = [wall_page(one, person and n == 1) for n, one in enumerate(colours)]
    return together(quads, pages)


def turning(n):
    """(n, 4, 4) T_camera_map of a camera that turns in the middle, 1.4 m high."""
    from stillmap.results.report.point_view import look_at

    eye = np.array([0.0, 0.0, 1.4])
    angles = 2 * np.pi * np.arange(n) / n
    ahead = np.stack([np.cos(angles), np.sin(angles), np.zeros(n)], axis=1)
    return np.array([look_at(eye, eye + one) for one in ahead])
