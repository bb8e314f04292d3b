"""A place over its sessions, read from its files."""

import json

import numpy as np
import pytest
from small_place import CELL, CHAIR, NAMES, SIZE, box_of, make_changes, make_place, write_states

from stillmap.core.errors import InputError
from stillmap.results.timeline import format_date_time, read_timeline


@pytest.fixture
def place(tmp_path):
    return make_place(tmp_path / "place")


def test_sessions_are_those_that_were_accepted_in_the_order_of_the_states(place):
    order = [NAMES[k] for k in (2, 0, 1, 3)]
    write_states(place, order)
    (place / "changes.json").write_text("[]")
    timeline = read_timeline(place)
    assert [one.name for one in timeline.sessions] == order
    assert [(one.name, one.why) for one in timeline.refused] == [("lost", "no <i>overlap</i>")]
    assert timeline.sessions[1].input == "/logs/monday.bag"
    assert timeline.sessions[1].T_place_session[:2, 2].tolist() == [1.5, -2.25]


def test_changes_have_kind_box_and_sessions(place):
    timeline = read_timeline(place)
    assert [one.label for one in timeline.changes] == ["A0", "M1", "D2", "G3"]
    assert [one.between for one in timeline.changes] == [
        (NAMES[a], NAMES[b]) for a, b in ((0, 1), (1, 2), (1, 2), (1, 3))
    ]
    moved, door = timeline.changes[1:3]
    np.testing.assert_allclose(moved.boxes[1], door.boxes[0])
    assert len(moved.boxes) == 2
    assert len(door.boxes) == 1
    assert [one.id for one in timeline.changes_at(2)] == [1, 2]
    assert timeline.changes_at(0) == []


def test_boxes_in_space(place):
    changes = [{**one, "box": [*one["box"], 0.0, 0.8]} for one in make_changes()]
    changes[1]["from_box"] = [*changes[1]["from_box"], 0.1, 0.9]
    (place / "changes.json").write_text(json.dumps(changes))
    moved = read_timeline(place).changes[1]
    assert [(low[2], high[2]) for low, high in moved.boxes] == [(0.0, 0.8), (0.1, 0.9)]


def test_titles_have_number_name_and_date(place, tmp_path):
    timeline = read_timeline(place)
    assert timeline.title(1) == "session 2 of 4: tuesday, 2026-05-29"
    hourly = read_timeline(make_place(tmp_path / "hourly", step=3600 * 10**9))
    assert hourly.title(0) == "session 1 of 4: monday, 2026-05-28 20:26"
    assert hourly.title(1).endswith("2026-05-28 21:26")


def test_stamps_since_a_robot_was_started_are_no_dates():
    assert format_date_time(12_345 * 10**9) == format_date_time(-1) == ""
    assert format_date_time(1_000_000_000 * 10**9) == "2001-09-09 01:46"


def test_cells_are_as_last_observed_else_as_first_observed(place):
    cells = read_timeline(place).cells
    cells.observed[:] = [[False, True, False, True]]
    cells.occupied[:] = [[False, True, False, False]]
    assert [cells.occupied_as_of(k)[0] for k in range(4)] == [True, True, True, False]


def test_only_cells_of_listed_changes_are_highlighted(place):
    timeline = read_timeline(place)
    n = SIZE**2
    now, came, left = timeline.cells_as_of(2)
    assert np.flatnonzero(left).tolist() == [*range(2 * n, 3 * n)]
    assert np.flatnonzero(came).tolist() == [*range(3 * n, 4 * n)]
    assert np.flatnonzero(now).tolist() == [*range(2 * n), *range(3 * n, 4 * n)]
    (place / "changes.json").write_text("[]")
    quiet, came, left = read_timeline(place).cells_as_of(2)
    assert (quiet == now).all()
    assert not came.any()
    assert not left.any()


def test_place_without_changes(place):
    none = {"cells": np.zeros((0, 2), np.int32), "shown": np.zeros(0, bool)}
    none |= {name: np.zeros((0, 4), bool) for name in ("occupied", "observed")}
    write_states(place, **none)
    (place / "changes.json").write_text("[]")
    timeline = read_timeline(place)
    assert [len(part) for part in timeline.cells_as_of(3)] == [0, 0, 0]


def changed(**fields):
    """`changes.json` whose second entry has other fields; None: without one."""
    changes = make_changes()
    changes[1] = {k: v for k, v in {**changes[1], **fields}.items() if v is not None}
    return json.dumps(changes)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{}", "Expected `array`"),
        ("[" * 100_000, "damaged"),
        (changed(kind="flew"), r"'flew' - at `\$\[1\].kind`"),
        (changed(box=[0, 0, 1, float("nan")]), "no number"),
        (changed(from_box=None), "change 1"),
        (changed(between=["tuesday", "never"]), "change 1"),
        (changed(between=["wednesday", "tuesday"]), "change 1"),
        (changed(id=0), "change 0"),
    ],
)
def test_damaged_changes_are_refused(place, content, said):
    (place / "changes.json").write_text(content)
    with pytest.raises(InputError, match=said) as caught:
        read_timeline(place)
    assert caught.value.where == str(place / "changes.json")


@pytest.mark.parametrize(
    "other",
    [
        {"cells": np.zeros((64, 3), np.int32)},
        {"occupied": np.zeros((64, 5), bool)},
        {"observed": np.ones((64, 4), np.uint8)},
        {"resolution": np.array(np.nan)},
        {"sessions": np.array(["monday"] * 4)},
        {"sessions": np.array([*NAMES[:3], "friday"])},
    ],
)
def test_damaged_states_are_refused(place, other):
    write_states(place, **other)
    with pytest.raises(InputError) as caught:
        read_timeline(place)
    assert caught.value.where == str(place / "states.npz")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("overlap", 1.5),
        ("last_stamp_ns", 2**70),
        ("T_place_session", [[1, 0, 0], [0, 1, 0], [0, 0, None]]),
        ("name", "../monday"),
    ],
)
def test_damaged_sessions_are_refused(place, name, value):
    records = json.loads((place / "sessions.json").read_text())
    records[0][name] = value
    (place / "sessions.json").write_text(json.dumps(records))
    with pytest.raises(InputError) as caught:
        read_timeline(place)
    assert caught.value.where == str(place / "sessions.json")


@pytest.mark.parametrize("name", ["sessions.json", "changes.json", "states.npz"])
def test_missing_and_cut_files_are_refused(place, name):
    content = (place / name).read_bytes()
    (place / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError):
        read_timeline(place)
    (place / name).unlink()
    with pytest.raises(InputError, match="cannot be read"):
        read_timeline(place)


def test_box_of_a_change_is_where_its_cells_are(place):
    timeline = read_timeline(place)
    inside = timeline.cells.within(timeline.changes[:1])
    assert np.flatnonzero(inside).tolist() == [*range(SIZE**2)]
    low = timeline.cells.centers[inside].min(axis=0) - CELL / 2
    assert low == pytest.approx(box_of(CHAIR)[:2])
