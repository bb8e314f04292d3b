"""The report on moving objects (tracks, traffic, table) and on a second laser."""

from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from stillmap.mapping.beam_statistics import sample_dynamic_points
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.snapshots import Window
from stillmap.results.report.figures import data_uri, draw_points
from stillmap.results.report.maps import MapFigure
from stillmap.results.run_json import tilting_record
from stillmap.tracking import FlowMap, MovingObject
from stillmap.tracking.objects import mean_speed, track_length

if TYPE_CHECKING:
    from stillmap.pipeline.tilting import TiltingResult

_MAX_TRACKS, _MAX_ROWS = 500, 25
_PALETTE = 64  # colors of the traffic map
# of cells crossed once, and of those crossed most often
_PALE, _DARK = np.array([255.0, 226.0, 178.0]), np.array([150.0, 20.0, 10.0])
_WALL = 90  # grey level up to which a pixel stays visible as a wall


def objects_data(result: MappingResult, filtered: MapFigure | None) -> dict[str, Any] | None:
    """Tracks and traffic on the map; None where objects were not tracked or the map is empty."""
    if not result.options.objects.enabled or filtered is None:
        return None
    objects = sorted(result.objects, key=lambda one: track_length(one.xy), reverse=True)
    if not objects:
        return {"total": 0}
    view, traffic = filtered.view, result.traffic
    speeds = [mean_speed(one.velocity) for one in objects]
    rows = [(_seconds(one), speed) for one, speed in zip(objects, speeds, strict=True)]
    return {
        "total": len(objects),
        "returns": sum(len(one.beams) for one in objects),
        "median_seconds": float(np.median([seconds for seconds, _ in rows])),
        "median_speed": float(np.median(speeds)),
        "view": view,
        "map": filtered.uri,
        "tracks": [view.svg_points(one.xy) for one in objects[:_MAX_TRACKS]],
        "traffic": data_uri(draw_traffic(traffic, filtered.picture, view.window)),
        "traffic_cell": traffic.resolution,
        "max_crossings": int(traffic.crossings.max()),
        "listed": [
            {
                "id": one.id,
                "distance": track_length(one.xy),
                "seconds": seconds,
                "scans": len(one.scan),
                "returns": len(one.beams),
                "speed": speed,
                "size": one.size,
                "p_dynamic": one.p_dynamic,
            }
            for one, (seconds, speed) in zip(objects[:_MAX_ROWS], rows, strict=False)
        ],
    }


def draw_traffic(traffic: FlowMap, picture: Image.Image, window: Window) -> Image.Image:
    """The map's `picture` of a window with the crossed cells colored, on a logarithmic scale."""
    image = np.array(picture.convert("RGB"))
    height, width = image.shape[:2]
    x0, y0, x1, y1 = window
    x = x0 + (np.arange(width) + 0.5) * (x1 - x0) / width
    y = y1 - (np.arange(height) + 0.5) * (y1 - y0) / height
    padded = np.pad(traffic.crossings, 1)  # zero outside the grid
    column = np.floor((x - traffic.origin[0]) / traffic.resolution).astype(np.int64) + 1
    row = np.floor((y - traffic.origin[1]) / traffic.resolution).astype(np.int64) + 1
    row, column = row.clip(0, padded.shape[0] - 1), column.clip(0, padded.shape[1] - 1)
    crossings = padded[row[:, None], column]
    colored = (crossings > 0) & (image.min(axis=2) > _WALL)
    share = np.log1p(crossings[colored]) / np.log1p(max(int(traffic.crossings.max()), 1))
    image[colored] = (_PALE + share[:, None] * (_DARK - _PALE)).astype(np.uint8)
    return Image.fromarray(image).quantize(_PALETTE)


def _seconds(one: MovingObject) -> float:
    return 1e-9 * float(one.stamp_ns[-1] - one.stamp_ns[0])


def rig_data(tilting: "TiltingResult | None", filtered: MapFigure | None) -> dict[str, Any] | None:
    """Counts of the second laser and its dynamic returns on the map of the first."""
    if tilting is None:
        return None
    data: dict[str, Any] = {"record": tilting_record(tilting), "view": None}
    if filtered is not None:
        view = filtered.view
        ends = sample_dynamic_points(tilting.deskewed, tilting.poses, tilting.p_static)[:, :2]
        data |= {
            "view": view,
            "map": filtered.uri,
            "dynamic": data_uri(draw_points(ends, view)),
        }
    return data
