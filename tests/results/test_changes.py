"""What the writers say of places that changed: a layer of map.npz, a list in run.json, a table."""

import base64
import dataclasses
import io
import json

import numpy as np
import pytest
from PIL import Image
from report_page import Page

from stillmap.mapping import Change, Door
from stillmap.mapping.doors import DoorState
from stillmap.results.map_server import changed_cells, write_map_npz
from stillmap.results.report import maps
from stillmap.results.report.page import render_report
from stillmap.results.run_json import run_record

S = 10**9
RESOLUTION = 0.1
COLOURS = {1: (20, 120, 60), 2: (190, 40, 120), 3: (40, 90, 200)}


def block(x, y, width, height):
    columns, rows = np.meshgrid(np.arange(x, x + width), np.arange(y, y + height))
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(np.int64)


def change(result, kind, cells, *seconds, times=1):
    x, y = ((cells.mean(axis=0) + 0.5) * RESOLUTION).tolist()
    width, height = ((np.ptp(cells, axis=0) + 1) * RESOLUTION).tolist()
    start = int(result.recording.stamp_ns[0])
    before, stamp, last = (start + round(s * S) for s in seconds)
    return Change(kind, x, y, (width, height), cells, RESOLUTION, before, stamp, last, times)


@pytest.fixture(scope="module")
def changed(result):
    """Something came, something left from a part of its place, and two bays are filled by turns."""
    bays = np.concatenate([block(60, 30, 6, 3), block(72, 30, 6, 3)])
    return dataclasses.replace(
        result,
        changes=[
            change(result, "came", block(10, 20, 4, 3), 2.04, 3.0, 3.0),
            change(result, "comes and goes", bays, 4.0, 5.25, 4000.0, times=7),
            change(result, "left", block(12, 20, 4, 3), 3723.4, 3725.0, 3725.0),
        ],
    )


def layer(result, cells):
    """The values of cells (K, 2) of the map frame: its origin is cell -10, -20."""
    column, row = (cells - [-10, -20]).T
    return set(changed_cells(result.map, result.changes)[row, column].tolist())


def test_the_layer_says_how_a_place_changed(changed):
    assert layer(changed, block(10, 20, 2, 3)) == {1}
    assert layer(changed, block(60, 30, 6, 3)) == layer(changed, block(72, 30, 6, 3)) == {3}
    assert layer(changed, block(66, 30, 6, 3)) == {0}  # what lies between may be anything
    assert layer(changed, block(9, 20, 1, 3)) == layer(changed, block(16, 20, 1, 3)) == {0}
    counts = np.bincount(changed_cells(changed.map, changed.changes).ravel())
    assert counts[1:].tolist() == [6, 12, 36]


def test_the_layer_holds_all_that_a_door_sweeps_over(result):
    leaves = np.concatenate([block(60, 30, 10, 2), block(60, 32, 2, 8)])
    states = (DoorState("shut", 4, 5), DoorState("open", 6, 7))
    door = Door(
        (6.05, 3.05), 1.0, 0.0, 0.5 * np.pi, leaves[:20], leaves[20:], block(60, 30, 8, 8), states
    )
    one = change(result, "door", leaves, 4.0, 5.25, 4000.0, times=7)
    one = dataclasses.replace(one, door=door)
    swung = dataclasses.replace(result, changes=[one])
    assert layer(swung, block(61, 31, 6, 6)) == {4}
    assert layer(swung, block(69, 39, 3, 3)) == {0}
    (listed,) = run_record(swung)["changes"]
    assert listed["cells"] == len(leaves)  # those that changed
    assert listed["door"] == {
        "hinge": [6.05, 3.05],
        "length": 1.0,
        "shut": 0.0,
        "open": round(0.5 * np.pi, 3),
        "states": [
            {"position": "shut", "since_ns": 4, "until_ns": 5},
            {"position": "open", "since_ns": 6, "until_ns": 7},
        ],
    }


def test_a_door_that_was_only_seen_shut_is_listed_without_a_change(result):
    none = np.empty((0, 2), np.int64)
    leaf, states = block(60, 30, 10, 1), (DoorState("shut", 4, 7),)
    door = Door((6.05, 3.05), 1.0, 0.0, np.nan, leaf, none, leaf, states, 0.61234)
    record = run_record(dataclasses.replace(result, doors=[door]))
    assert record["changes"] == []
    (listed,) = record["doors"]
    assert listed["open"] is None
    assert listed["p_moved"] == 0.6123
    assert [one["position"] for one in listed["states"]] == ["shut"]


def test_the_last_of_several_changes_is_told(changed):
    assert layer(changed, block(12, 20, 2, 3)) == {2}
    turned = dataclasses.replace(changed, changes=changed.changes[::-1])
    assert layer(turned, block(12, 20, 2, 3)) == {2}


def test_the_layer_is_written_beside_the_map(tmp_path, changed, result):
    write_map_npz(tmp_path / "map.npz", changed.map, changed.changes)
    with np.load(tmp_path / "map.npz") as read:
        written = read["changed"]
        assert written.shape == read["p_occupied"].shape
    assert written.dtype == np.uint8
    np.testing.assert_array_equal(written, changed_cells(changed.map, changed.changes))
    write_map_npz(tmp_path / "none.npz", result.map)
    with np.load(tmp_path / "none.npz") as read:
        assert not read["changed"].any()


def test_cells_beside_the_map_are_left_out(result):
    height, width = result.map.p_occupied.shape
    for at in ((-12, -22), (width - 12, height - 22)):
        one = change(result, "came", block(*at, 4, 4), 1.0, 2.0, 2.0)
        assert np.count_nonzero(changed_cells(result.map, [one])) == 4
    away = change(result, "came", block(5000, 0, 4, 4), 1.0, 2.0, 2.0)
    assert not changed_cells(result.map, [away]).any()


def test_run_json_lists_every_change(changed):
    start = int(changed.recording.stamp_ns[0])
    assert run_record(dataclasses.replace(changed, changes=[]))["changes"] == []
    listed = run_record(changed)["changes"]
    assert json.loads(json.dumps(listed, allow_nan=False)) == listed
    assert listed[0] == {
        "kind": "came",
        "x": 1.2,
        "y": 2.15,
        "size": [0.4, 0.3],
        "cells": 12,
        "before_ns": start + 2_040_000_000,
        "stamp_ns": start + 3 * S,
        "last_ns": start + 3 * S,
        "times": 1,
    }
    assert [one["kind"] for one in listed] == ["came", "comes and goes", "left"]
    assert listed[1]["times"] == 7
    assert listed[1]["last_ns"] == start + 4000 * S
    assert listed[1]["cells"] == 36


def test_without_changes_there_is_no_section(result, changed):
    assert "Changed places" not in render_report(result)
    empty = dataclasses.replace(changed.map, p_occupied=np.zeros((0, 0), np.float32))
    without_map = dataclasses.replace(changed, map=empty, raw_map=empty)
    assert "Changed places" not in render_report(without_map)


def pictures_of(page):
    data = [one["src"].partition(",")[2] for one in page.named("img")]
    return [Image.open(io.BytesIO(base64.b64decode(one))) for one in data]


@pytest.fixture
def changes_section(section):
    """A function: the section on changed places in the report of a result."""
    return lambda result: " ".join(section(render_report(result), "Changed places").split())


def test_the_table(changed, changes_section):
    section = Page(changes_section(changed))
    head, *rows = section.rows
    assert len(head) == 8
    assert rows == [
        ["1", "came", "1.20, 2.15", "0.40 x 0.30", "12", "0:00:02.0", "0:00:03.0", "1"],
        ["2", "comes and goes", "6.90, 3.15", "1.80 x 0.30", "36", "0:00:04.0", "0:00:05.2", "7"],
        ["3", "left", "1.40, 2.15", "0.40 x 0.30", "12", "1:02:03.4", "1:02:05.0", "1"],
    ]
    assert "3 changed places: 1 came, 1 left, 1 comes and goes." in "".join(section.text)
    one = dataclasses.replace(changed, changes=changed.changes[:1])
    assert "1 changed place: 1 came." in changes_section(one)


def test_changed_cells_are_drawn_in_the_colors_of_their_kinds(changed, changes_section):
    picture, marks = pictures_of(Page(changes_section(changed)))
    assert picture.size == marks.size
    pixels = np.asarray(marks.convert("RGBA")).reshape(-1, 4)
    solid = pixels[pixels[:, 3] > 0][:, :3]
    colours, counts = np.unique(solid, axis=0, return_counts=True)
    found = dict(zip(map(tuple, colours.tolist()), counts.tolist(), strict=True))
    # a pixel is a cell: the map is small
    assert found == {COLOURS[1]: 6, COLOURS[2]: 12, COLOURS[3]: 36}


def test_table_lists_the_largest_changes(changed, result, changes_section, monkeypatch):
    monkeypatch.setattr(maps, "_MAX_ROWS", 2)
    small = change(result, "left", block(40, 40, 2, 2), 1.0, 2.0, 2.0)
    section = Page(changes_section(dataclasses.replace(changed, changes=[small, *changed.changes])))
    assert [row[1] for row in section.rows[1:]] == ["came", "comes and goes"]
    assert "2 smaller ones are in run.json." in "".join(section.text)
    assert "4 changed places" in "".join(section.text)
