"""`report.html` of a place."""

import base64
import hashlib
import html
import io
import json
import re
from dataclasses import replace

import pytest
from PIL import Image
from report_page import Page
from small_place import RECORD, make_place

from stillmap.results.reader import read_grid
from stillmap.results.report.figures import MapView
from stillmap.results.report.place import place_mark, render_place_report
from stillmap.results.timeline import read_timeline


def rendered(folder, record=RECORD):
    return render_place_report(folder, read_grid(folder), "trinary", record)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return make_place(tmp_path_factory.mktemp("made up") / "place")


@pytest.fixture(scope="module")
def text(place):
    return rendered(place)


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def section_of(text, title):
    return text.split(f">{title}</h2>")[1].split("</section>")[0]


def test_page_asks_for_nothing_outside(text, page):
    for tag, attrs in page.tags:
        for name in ("src", "href"):
            where = attrs.get(name, "")
            if tag != "a" and not where.startswith("#"):
                assert where == "" or where.startswith("data:image/"), (tag, where)
    assert not re.search(r"url\((?!data:)", text)
    policy = page.named("meta")[1]["content"]
    script = re.search(r"<script>(.*)</script>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy


def test_names_are_escaped(text):
    assert "thursday <b>" not in text
    assert "thursday &lt;b&gt;" in text
    assert "no <i>overlap" not in text


def test_every_session_has_a_row(page):
    rows = {row[1]: row for row in page.rows if row[1:2] and row[0] in ("1", "2", "3", "4", "-")}
    assert [*rows] == ["monday", "tuesday", "wednesday", "thursday <b>", "lost"]
    tuesday = rows["tuesday"]
    assert tuesday[2] == "2026-05-29 20:26"
    assert tuesday[3:] == ["4 s", "yes", "75.0 %", "1.50, -2.25", "5.7°", "/logs/tuesday.bag"]
    assert rows["lost"][4] == "no: no <i>overlap</i>"
    assert rows["lost"][-1] == "/logs/lost.bag"


def test_changes_are_listed_between_their_sessions(text):
    parts = section_of(text, "Changes between sessions").split("<h3>")[1:]
    assert [html.unescape(part.split("</h3>")[0]) for part in parts] == [
        "1 to 2: monday (2026-05-28) to tuesday (2026-05-29)",
        "2 to 3: tuesday (2026-05-29) to wednesday (2026-05-30)",
        "3 to 4: wednesday (2026-05-30) to thursday <b> (2026-05-31)",
    ]
    tables = [re.search(r"<table>.*</table>", one, re.DOTALL)[0] for one in parts]
    rows = [Page(one).rows[1:] for one in tables]
    assert rows[0] == [["A0", "appeared", "-0.60, 1.20", "0.40 x 0.40", "0.90", ""]]
    assert rows[1] == [
        ["M1", "moved", "2.80, 1.80", "0.40 x 0.40", "0.91", "from 2.20, 1.20"],
        ["D2", "door", "2.20, 1.20", "0.40 x 0.40", "0.92", ""],
    ]
    assert rows[2][0][:2] == ["G3", "gone"]
    assert rows[2][0][-1] == "last seen before by tuesday"


def test_base_map_is_there_once_and_sessions_as_differences(text):
    assert text.count('<image id="place-map"') == 1
    assert text.count('<use href="#place-map"/>') == 3
    patches = re.findall(
        r'<image class="" href="data:image/png;base64,([^"]+)" x="(\d+)" y="(\d+)" width="(\d+)"',
        text,
    )
    assert len(patches) == 3
    for data, _, _, width in patches:
        assert Image.open(io.BytesIO(base64.b64decode(data))).width == int(width)


def test_trajectory_of_every_session_is_on_the_map(text):
    main_map = section_of(text, "Map")
    assert main_map.count("<polyline") == 4
    assert re.findall(r">(\d)</text>", main_map) == ["1", "2", "3", "4"]


def test_place_without_changes(tmp_path):
    folder = make_place(tmp_path / "place")
    (folder / "changes.json").write_text("[]")
    page = rendered(folder)
    assert "Nothing changed between the sessions." in page
    assert 'id="place-map"' not in page


def test_links_lead_to_files(place, page):
    links = [one["href"] for one in page.named("a")]
    assert {"sessions.json", "changes.json", "states.npz", "map.npz"} <= {*links}
    assert all((place / link).is_file() for link in links)


def test_many_sessions_take_little_space(tmp_path):
    names = [f"day {k}" for k in range(32)]
    folder = make_place(tmp_path / "place", names=names)
    (folder / "changes.json").write_text(json.dumps(_daily(names)))
    page = rendered(folder)
    assert page.count('class="preview"') == 32
    assert len(page) < 500_000


def _daily(names):
    """40 changes from every session to the next."""
    return [
        {
            "id": 40 * k + n,
            "kind": "appeared",
            "box": [-3 + 0.1 * n, -2, -2.7 + 0.1 * n, -1.5],
            "between": names[k : k + 2],
            "probability": 0.9,
        }
        for k in range(len(names) - 1)
        for n in range(40)
    ]


def test_marks_are_around_what_changed(place):
    view = MapView((-4.0, -3.0, 4.0, 3.0), (800, 600))
    marks = [place_mark(one, view) for one in read_timeline(place).changes]
    assert [one["label"] for one in marks] == ["A0", "M1", "D2", "G3"]
    assert marks[0]["centers"] == [pytest.approx((340.0, 180.0))]
    assert marks[1]["centers"] == [pytest.approx((680.0, 120.0)), pytest.approx((620.0, 180.0))]
    assert marks[0]["boxes"][0] == pytest.approx((315.0, 155.0, 50.0, 50.0))
    assert marks[0]["text"][0] > 365.0
    far = replace(read_timeline(place).changes[0], box=(3.5, 0.0, 3.9, 0.4))
    x, _, is_before = place_mark(far, view)["text"]
    assert is_before
    assert x < 750.0
