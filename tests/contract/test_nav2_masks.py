"""Edited maps and masks of costmap filters, by the public rules of nav2.

Beside those of the map server: KeepoutFilter raises the cost of a cell to that of the mask and
fills cells of which the costmap knows nothing, unless the mask knows nothing either; base and
multiplier must be 0 and 1. SpeedFilter reads base + multiplier * value as the limit, in per cent
(type 1) or m/s (type 2); 0 in the mask is no limit, an unknown cell an error.
"""

import json

import numpy as np
import pytest
import yaml
from map_server_rules import FREE, OCCUPIED, UNKNOWN, load

from stillmap.cli.main import main

LETHAL, NO_INFORMATION = 254, 255


def feature(action, *polygons, **properties):
    kind, coordinates = "MultiPolygon", [list(polygon) for polygon in polygons]
    if len(polygons) == 1:
        kind, [coordinates] = "Polygon", coordinates
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": {"action": action, **properties}, "geometry": geometry}


def box(x0, y0, x1, y1):
    return [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]


@pytest.fixture
def convert(result, tmp_path):
    """Converts the result to a folder for nav2; features make a file of zones."""

    def run(*features, flags=(), source=result):
        words = ["convert", source, "-o", tmp_path / "nav2", "--to", "nav2", "--overwrite", *flags]
        if features:
            path = tmp_path / "zones.geojson"
            path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
            words += ["--mask", path]
        assert main([*map(str, words)]) == 0
        return tmp_path / "nav2"

    return run


@pytest.fixture
def middle(result):
    """x, y of a place in the middle of the map, on a corner of cells."""
    with np.load(result / "map.npz") as archive:
        shape, origin = np.array(archive["p_occupied"].shape), archive["origin"]
        return tuple(origin[:2] + float(archive["resolution"]) * (shape[::-1] // 2))


def centres(grid):
    """x (W,) and y (H,) of the centres of the cells."""
    x0, y0, _ = grid.origin
    height, width = grid.cells.shape
    return (
        x0 + (np.arange(width) + 0.5) * grid.resolution,
        y0 + (np.arange(height) + 0.5) * grid.resolution,
    )


def inside(grid, ring):
    """Cells whose centre a ring winds around, by the sum of the angles to its corners."""
    x, y = np.meshgrid(*centres(grid))
    corners = np.array(ring)
    dx, dy = corners[:, 0, None, None] - x, corners[:, 1, None, None] - y
    turns = np.diff(np.arctan2(dy, dx), axis=0)
    return np.abs(((turns + np.pi) % (2 * np.pi) - np.pi).sum(axis=0)) > np.pi


def filter_costs(costs, mask):
    """A costmap (H, W) after KeepoutFilter with a mask of the same cells."""
    of_mask = np.where(mask == UNKNOWN, NO_INFORMATION, np.rint(mask * LETHAL / 100)).astype(int)
    raises = (of_mask > costs) | (costs == NO_INFORMATION)
    return np.where((of_mask != NO_INFORMATION) & raises, of_mask, costs)


def speed_limits(mask, info):
    """(H, W) limits; 0: none."""
    assert (mask.cells != UNKNOWN).all()
    return np.where(mask.cells == 0, 0.0, info["base"] + info["multiplier"] * mask.cells)


def parameters(folder):
    content = yaml.safe_load((folder / "nav2_params.yaml").read_text())
    return {name: one.get("ros__parameters", one) for name, one in content.items()}


def test_unedited_map_is_the_results(convert, result):
    folder = convert()
    assert sorted(p.name for p in folder.iterdir()) == ["map.pgm", "map.yaml", "nav2_params.yaml"]
    for name in ("map.pgm", "map.yaml"):
        assert (folder / name).read_bytes() == (result / name).read_bytes()
    assert parameters(folder) == {"map_server": {"yaml_filename": "map.yaml"}}


def test_zones_on_the_map(convert, result, middle):
    """Triangles, holes and several polygons: the cells whose centres are inside, no others."""
    x, y = middle
    triangle = [[x + 0.01, y], [x + 3.03, y + 0.21], [x + 1.13, y + 2.47], [x + 0.01, y]]
    outline, hole = box(x - 4, y - 4, x - 1.02, y - 1.49), box(x - 3, y - 3, x - 2, y - 2)
    other = box(x - 4, y + 1, x - 3, y + 2)
    grid = load(
        convert(feature("block", [triangle]), feature("erase", [outline, hole], [other]))
        / "map.yaml"
    )
    before = load(result / "map.yaml")
    blocked = inside(grid, triangle)
    erased = inside(grid, outline) & ~inside(grid, hole) | inside(grid, other)
    expected = np.where(erased, FREE, np.where(blocked, OCCUPIED, before.cells))
    np.testing.assert_array_equal(grid.cells, expected)
    assert (grid.cells != before.cells).sum() > 500
    assert grid.origin == before.origin


def test_keepout_mask(convert, result, middle):
    x, y = middle
    zone, part = box(x - 3, y - 2, x, y + 2), box(x - 2, y - 1, x - 1, y + 1)
    blocked = box(x + 1, y, x + 2, y + 1)
    folder = convert(
        feature("keepout", [zone]), feature("erase", [part]), feature("block", [blocked])
    )
    mask, grid = load(folder / "keepout.yaml"), load(folder / "map.yaml")
    kept_out = inside(mask, zone) & ~inside(mask, part) | inside(mask, blocked)
    np.testing.assert_array_equal(mask.cells == OCCUPIED, kept_out)
    with np.load(result / "map.npz") as archive:
        unknown = np.isnan(archive["p_occupied"])
    np.testing.assert_array_equal(mask.cells == UNKNOWN, unknown & ~kept_out & ~inside(mask, part))
    assert (mask.origin, mask.resolution) == (grid.origin, grid.resolution)
    # a costmap with static layer: nothing but the zones changes
    costs = np.select([grid.cells == OCCUPIED, unknown], [LETHAL, NO_INFORMATION], 0)
    filtered = filter_costs(costs, mask.cells)
    np.testing.assert_array_equal(filtered[kept_out], LETHAL)
    np.testing.assert_array_equal(filtered[~kept_out], costs[~kept_out])
    info = parameters(folder)["keepout_costmap_filter_info_server"]
    assert (info["type"], info["base"], info["multiplier"]) == (0, 0.0, 1.0)


@pytest.mark.parametrize("percent", [1, 12.5, 30, 99, 100])
def test_speed_mask_in_percent(convert, middle, percent):
    x, y = middle
    zone, other = box(x, y, x + 2, y + 1), box(x + 1, y, x + 2, y + 2)
    folder = convert(
        feature("speed", [zone], speed="50%"), feature("speed", [other], speed=f"{percent}%")
    )
    mask = load(folder / "speed.yaml")
    info = parameters(folder)["speed_costmap_filter_info_server"]
    assert info["type"] == 1
    limits = speed_limits(mask, info)
    later, earlier = inside(mask, other), inside(mask, zone)
    expected = np.where(later, np.floor(percent) % 100, np.where(earlier, 50.0, 0.0))
    np.testing.assert_allclose(limits, expected)


@pytest.mark.parametrize(
    ("limits", "step"),
    [([0.3, 1.0], 0.01), ([0.3, 1.5], 0.02), ([0.2, 3.456], 0.05), ([60.0], 1.0)],
)
def test_speed_mask_in_metres_per_second(convert, middle, limits, step):
    x, y = middle
    zones = [box(x + n, y, x + n + 0.5, y + 1) for n in range(len(limits))]
    folder = convert(
        *(feature("speed", [zone], speed=one) for zone, one in zip(zones, limits, strict=True))
    )
    mask = load(folder / "speed.yaml")
    info = parameters(folder)["speed_costmap_filter_info_server"]
    assert (info["type"], info["multiplier"]) == (2, step)
    found = speed_limits(mask, info)
    for zone, limit in zip(zones, limits, strict=True):
        [value] = np.unique(found[inside(mask, zone)])
        assert limit - step < value <= limit + 1e-9
    assert set(np.unique(found)) <= {0.0, *np.unique(found[found > 0])}


def test_zones_from_traffic(convert, result):
    with np.load(result / "traffic.npz") as archive:
        crossings, origin, edge = (archive[n] for n in ("crossings", "origin", "resolution"))
    most = int(crossings.max())
    assert most >= 2
    flags = ["--keepout-crossings", most, "--slow-crossings", 1, "--slow-to", "0.25"]
    folder = convert(flags=flags)
    keepout, speed = load(folder / "keepout.yaml"), load(folder / "speed.yaml")
    info = parameters(folder)["speed_costmap_filter_info_server"]
    x, y = np.meshgrid(*centres(keepout))
    column = np.floor((x - origin[0]) / edge).astype(int)
    row = np.floor((y - origin[1]) / edge).astype(int)
    height, width = crossings.shape
    count = np.zeros(x.shape, int)
    on = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    count[on] = crossings[row[on], column[on]]
    np.testing.assert_array_equal(keepout.cells == OCCUPIED, count >= most)
    np.testing.assert_allclose(speed_limits(speed, info), np.where(count >= 1, 0.25, 0.0))
    assert (folder / "map.pgm").read_bytes() == (result / "map.pgm").read_bytes()


def test_zones_come_after_traffic(convert, result):
    """What traffic closes, `erase` opens again."""
    with np.load(result / "map.npz") as archive:
        shape, (x, y, _) = archive["p_occupied"].shape, archive["origin"]
        edge = float(archive["resolution"])
    whole = box(x, y, x + shape[1] * edge, y + shape[0] * edge)
    flags = ["--keepout-crossings", 1, "--slow-crossings", 1]
    folder = convert(feature("erase", [whole]), flags=flags)
    for name in ("map", "keepout", "speed"):
        assert (load(folder / f"{name}.yaml").cells == FREE).all()


def test_parameters_belong_together(convert, middle):
    x, y = middle
    zone = [box(x, y, x + 1, y + 1)]
    folder = convert(feature("keepout", zone), feature("speed", zone, speed="40%"))
    given = parameters(folder)
    assert (folder / given["map_server"]["yaml_filename"]).is_file()
    costmap = given["global_costmap"]["global_costmap"]["ros__parameters"]
    assert costmap["filters"] == ["keepout_filter", "speed_filter"]
    managed = given["lifecycle_manager_costmap_filters"]["node_names"]
    for name, plugin in (("keepout", "KeepoutFilter"), ("speed", "SpeedFilter")):
        server, info = (
            given[f"{name}_{node}_server"] for node in ("filter_mask", "costmap_filter_info")
        )
        assert {f"{name}_filter_mask_server", f"{name}_costmap_filter_info_server"} <= set(managed)
        assert (folder / server["yaml_filename"]).is_file()
        assert info["mask_topic"] == server["topic_name"]
        used = costmap[f"{name}_filter"]
        assert used["plugin"] == f"nav2_costmap_2d::{plugin}"
        assert used["filter_info_topic"] == info["filter_info_topic"]
    local = given["local_costmap"]["local_costmap"]["ros__parameters"]
    assert local["filters"] == ["keepout_filter"]
    # parameter files of ROS have no aliases
    assert "&" not in (folder / "nav2_params.yaml").read_text()


def test_plan_of_a_3d_result(convert, mapped_street):
    folder = convert(flags=["--slow-crossings", 1], source=mapped_street)
    assert (folder / "map.pgm").read_bytes() == (mapped_street / "map.pgm").read_bytes()
    assert (load(folder / "speed.yaml").cells == 50).sum() > 100
