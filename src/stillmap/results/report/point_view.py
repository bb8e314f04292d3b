"""The points of a 3D result in perspective: static ones by height, dynamic ones in orange."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.array_types import Float, Float32
from stillmap.mapping.labelled_recording import sample_points
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.tilting import TiltingResult
from stillmap.results.colors import ORANGE, color_by_height
from stillmap.results.report.figures import data_uri

_SIZE = (1280, 720)  # pixels
_CENTER = 0.5 * np.array(_SIZE) - 0.5  # pixel centers have integer coordinates
_FOCAL_LENGTH = 0.5 * _SIZE[0] / math.tan(math.radians(22.5))  # pixels
_MAX_STATIC, _MAX_DYNAMIC = 1_000_000, 200_000  # points drawn
_MAX_FITTED = 50_000  # points that choose the view
_POINT_SIZE = 0.05  # m, nearer than where this is a pixel points cover 2 x 2 pixels
_ELEVATION, _TURN = math.radians(35.0), math.radians(25.0)  # of the view, from the side of the map
_OUTLIERS = 0.01  # share of the points beyond each side of what the view shows
_OVERHEAD = 0.5  # m above the robot's base from which on walls and a ceiling are looked at
_CEILING = 0.3  # m below the highest points that a ceiling takes, and that are left out with it
_CEILING_DENSITY = 2.0  # times as many points as at the same thickness of wall below
_WALL_BANDS = 3  # of that thickness, below the ceiling
_BACKGROUND = (16, 20, 26)
_JPEG_QUALITY = 88
_NEAR = 0.05  # m, near plane
_MARGIN = 1.05  # around fitted points


def points_data(
    result: MappingResult, tilting: TiltingResult | None = None
) -> dict[str, Any] | None:
    """The static points, and the same with dynamic ones, as seen from above and aside.

    Where there is a ceiling, it is left out. None without points in 3D.
    """
    seen = (result if tilting is None else tilting).near
    if seen.recording.dimension == 2:
        return None
    deskewed, poses = seen.deskewed, seen.poses
    samples = (
        sample_points(deskewed, poses, seen.p_static, _MAX_STATIC, dynamic=False),
        sample_points(deskewed, poses, seen.p_static, _MAX_DYNAMIC),
    )
    static, dynamic = (np.asarray(points, np.float32) for points in samples)
    ceiling = find_ceiling(static[:, 2], float(poses[:, 2, 3].mean()))
    static, dynamic = (points[points[:, 2] < ceiling] for points in (static, dynamic))
    if not len(static):
        return None
    heights_shown = np.quantile(static[:, 2], [_OUTLIERS, 1.0 - _OUTLIERS]).round(1) + 0.0
    low, high = heights_shown.tolist()
    above = float(result.origin[2])
    heights = color_by_height(static[:, 2], low, high)
    orange = np.broadcast_to(np.array(ORANGE, np.uint8), (len(dynamic), 3))
    T = _choose_view(static)
    pictures = [
        draw_points_3d(static, heights, T),
        draw_points_3d(np.concatenate([static, dynamic]), np.concatenate([heights, orange]), T),
    ]
    return {
        "size": _SIZE,
        "images": [data_uri(one, "jpeg", quality=_JPEG_QUALITY) for one in pictures],
        "heights": (low + above, high + above),
        "has_ceiling": math.isfinite(ceiling),
    }


def find_ceiling(z: Float32, base: float) -> float:
    """Lowest height of the ceiling in m; inf: there is none.

    Walls have no more points at their top than below, a ceiling has many.

    Args:
        z: (n,) heights of points in m.
        base: height of the robot in m.
    """
    overhead = z[z > base + _OVERHEAD]
    if not len(overhead):
        return math.inf
    top = float(np.quantile(overhead, 1.0 - _OUTLIERS / 2))
    edges = top - _CEILING * np.array([1 + _WALL_BANDS, 1])
    below, above = (int(np.count_nonzero(overhead > edge)) for edge in edges)
    walls = (below - above) / _WALL_BANDS
    return float(edges[1]) if above > _CEILING_DENSITY * walls else math.inf


def draw_points_3d(points: Float32, colors: NDArray[np.uint8], T_camera_map: Float) -> Image.Image:
    """Points (n, 3) in colors (n, 3) over a dark background; nearer ones hide those behind."""
    width, height = _SIZE
    local = points @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
    ahead = np.flatnonzero(local[:, 2] > 0.0)
    # far ones first, so that near ones are painted over them
    order = ahead[np.argsort(-local[ahead, 2], kind="stable")]
    z = local[order, 2]
    column, row = (
        np.floor(local[order, k] / z * _FOCAL_LENGTH + _CENTER[k] + 0.5).astype(np.int64)
        for k in (0, 1)
    )
    large = z < _POINT_SIZE * _FOCAL_LENGTH
    pixels = np.empty((height, width, 3), np.uint8)
    pixels[:] = _BACKGROUND
    for down, right in ((1, 1), (1, 0), (0, 1), (0, 0)):
        y, x = row + down, column + right
        shown = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        if down or right:
            shown &= large
        pixels[y[shown], x[shown]] = colors[order[shown]]
    return Image.fromarray(pixels)


def _choose_view(points: Float32) -> Float:
    """T_camera_map (4, 4) from above and aside of the longer side of the place."""
    some = points[:: -(-len(points) // _MAX_FITTED)].astype(np.float64)
    low, high = np.quantile(some, [_OUTLIERS, 1.0 - _OUTLIERS], axis=0)
    inside = some[((some >= low) & (some <= high)).all(axis=1)]
    x, y = (high - low)[:2].tolist()
    yaw = _TURN - (math.pi / 2 if x >= y else 0.0)
    direction = np.array([math.cos(yaw), math.sin(yaw), math.tan(_ELEVATION)])
    return fit_camera(inside if len(inside) else some, direction)


def fit_camera(points: Float, direction: Float) -> Float:
    """T_camera_map (4, 4) of the closest camera whose image contains all points (n, 3), centered.

    In camera axes, with s the slope of the edge of the field of view, a point (x, y, z) is inside
    the right edge of a camera at e if x - e_x <= s (z - e_z), and inside the left edge if
    e_x - x <= s (z - e_z). The extreme points of both conditions bound e_z; likewise for y.

    Args:
        points: m.
        direction: (3,) from the points towards the camera, not vertical; z is up in the image.
    """
    forward = -direction / np.linalg.norm(direction)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    local = points @ R.T
    slopes = 0.5 * np.array(_SIZE) / _FOCAL_LENGTH / _MARGIN
    most = (local[:, :2] - slopes * local[:, 2:]).max(axis=0)
    least = (-local[:, :2] - slopes * local[:, 2:]).max(axis=0)
    z = min(float((-(least + most) / (2.0 * slopes)).min()), local[:, 2].min() - 2.0 * _NEAR)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = -np.array([*(0.5 * (most - least)), z])
    return T
