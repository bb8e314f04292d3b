"""Draw the pictures of README.md from simulated recordings: what was recorded beside what is kept.

    python docs/figures/make_pictures.py

Needs stillmap alone; about three minutes on one core. Seeds are fixed, so the same version draws
the same pictures.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from render_points import View, halve, render, shade

import stillmap
from stillmap.sim import scene_by_name, simulate

HERE = Path(__file__).parent
SEED = 100
WIDTH, GAP, CAPTION, CORNER = 780, 20, 46, 14  # pixels
BACKGROUND, FLOOR, WALL, ORANGE = (
    np.array(color, float)
    for color in ((13, 24, 35), (24, 40, 56), (225, 238, 248), (255, 140, 40))
)
LOW, MIDDLE, HIGH = (
    np.array(color, float) for color in ((40, 74, 104), (126, 182, 212), (240, 246, 250))
)
HALL = {
    "crowd": {"people": 45},
    "laser": {"max_range": 15.0, "beams": 360, "fov": 4.7},
    "robot": {"scans": 1500},
}
CROSSING = {"lidar": {"channels": 64, "columns": 900}, "robot": {"scans": 130}}
CROSSING_VIEW = View((-33.0, -33.0, 28.0), (20.0, 3.0, 0.0), 2 * WIDTH, 1000, 0.98)


def main() -> None:
    """Simulate, map, draw."""
    draw_hall(HERE / "hall.webp")
    draw_crossing(HERE / "crossing.webp")


def map_scene(name: str, changes: dict) -> tuple[NDArray, NDArray, NDArray]:
    """Simulate and map a scene: its hits (n, D) in m in the map frame, whether each is static, and
    T_world_map."""
    simulation = simulate(scene_by_name(name, changes), SEED)
    result = stillmap.build(simulation.recording)
    recording = result.deskewed
    D = recording.dimension
    T_map_sensor = recording.T_map_sensor(result.poses)
    scan = np.repeat(np.arange(recording.n_scans), np.diff(recording.offset))[recording.hit]
    hits = np.einsum("nij,nj->ni", T_map_sensor[scan, :D, :D], recording.points[recording.hit])
    hits += T_map_sensor[scan, :D, D]
    T_world_map = simulation.truth.T_world_base[0] @ np.linalg.inv(result.poses[0])
    return hits, np.asarray(result.p_static[recording.hit]) >= 0.5, T_world_map


def draw_hall(path: Path) -> None:
    """The hall in 2D: density of hits over the known floor."""
    hits, static, T_world_map = map_scene("hall", HALL)
    hits = hits @ T_world_map[:2, :2].T  # walls along the edges of the picture
    low = np.percentile(hits[static], 0.05, axis=0) - 1.0
    high = np.percentile(hits[static], 99.95, axis=0) + 1.0
    scale = 2 * WIDTH / (high[0] - low[0])  # pixels per metre, drawn twice as large
    height = 2 * round((high[1] - low[1]) * scale / 2)

    def count(points: NDArray) -> NDArray:
        x, y = ((points - low) * scale).astype(int).T
        inside = (x >= 0) & (x < 2 * WIDTH) & (y >= 0) & (y < height)
        shape = (height, 2 * WIDTH)
        cells = np.ravel_multi_index((height - 1 - y[inside], x[inside]), shape)
        return np.bincount(cells, minlength=height * 2 * WIDTH).reshape(shape).astype(float)

    floor = np.where(fill_floor(count(hits[static]) > 0)[..., None], FLOOR, BACKGROUND)
    walls = blend(floor, 1 - np.exp(-count(hits[static]) / 1.2), WALL)
    moving = 1 - np.exp(-widen(count(hits[~static])) / 1.5)
    raw = blend(walls, 0.85 * moving, ORANGE)
    captions = ("what the laser saw: people in orange", "the map that stillmap writes")
    save_pair(path, halve(raw), halve(walls), captions)


def fill_floor(wall: NDArray) -> NDArray:
    """Pixels that the picture's border does not reach without crossing a wall."""
    from scipy import ndimage

    closed = ndimage.binary_closing(wall, iterations=6)
    regions, _ = ndimage.label(~closed)
    return (regions != regions[0, 0]) | closed


def widen(counts: NDArray) -> NDArray:
    """The largest of each pixel and its neighbours below and to the right."""
    counts = np.maximum(counts, np.roll(counts, 1, axis=0))
    return np.maximum(counts, np.roll(counts, 1, axis=1))


def blend(image: NDArray, opacity: NDArray, color: NDArray) -> NDArray:
    """Lay a colour over an image with an opacity (height, width)."""
    return image + (color - image) * opacity[..., None]


def draw_crossing(path: Path) -> None:
    """The crossing in 3D: every hit of the lidar, coloured by height."""
    hits, static, _ = map_scene("crossing", CROSSING)
    t = np.clip(hits[:, 2:] / 6.0, 0.0, 1.0)
    colors = np.where(t < 0.4, LOW + (MIDDLE - LOW) * t / 0.4, MIDDLE + (HIGH - MIDDLE) * (t - 0.4))
    colors[~static] = ORANGE
    pictures = []
    for shown in (slice(None), static):
        image, depth = render(hits[shown], colors[shown], CROSSING_VIEW, 0.05)
        pictures.append(halve(shade(image, depth, BACKGROUND)))
    captions = ("what the lidar saw: traffic in orange", "what is left in static.ply")
    save_pair(path, pictures[0], pictures[1], captions)


def save_pair(path: Path, left: NDArray, right: NDArray, captions: tuple[str, str]) -> None:
    """Two pictures side by side, each a card with round corners and a caption below."""
    height = left.shape[0] + CAPTION
    sheet = Image.new("RGBA", (2 * WIDTH + GAP, height))
    for x, picture, caption in zip((0, WIDTH + GAP), (left, right), captions, strict=True):
        card = Image.new("RGB", (WIDTH, height), tuple(int(c) for c in BACKGROUND))
        card.paste(Image.fromarray(picture.clip(0, 255).astype(np.uint8)), (0, 0))
        draw = ImageDraw.Draw(card)
        font = ImageFont.load_default(22)
        centre = (WIDTH // 2, height - CAPTION // 2 - 4)
        draw.text(centre, caption, fill=(205, 218, 230), font=font, anchor="mm")
        mask = Image.new("L", (4 * WIDTH, 4 * height))
        box = (0, 0, 4 * WIDTH - 1, 4 * height - 1)
        ImageDraw.Draw(mask).rounded_rectangle(box, 4 * CORNER, fill=255)
        sheet.paste(card, (x, 0), mask.resize((WIDTH, height), Image.Resampling.LANCZOS))
    sheet.save(path, quality=84, method=6)


if __name__ == "__main__":
    main()
