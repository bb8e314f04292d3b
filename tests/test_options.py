"""Options: refused values and their messages, and the round trip through TOML."""

import math
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest

from stillmap.core.config import (
    CheckedOptions,
    Count,
    declared_options,
    iter_options,
    load_toml,
    merge_nested,
    option,
    override,
    parse_assignment,
    to_toml,
)
from stillmap.core.errors import InputError
from stillmap.pipeline.options import Options


@dataclass(frozen=True)
class Inner(CheckedOptions):
    """The inner section."""

    width: float = option(0.5, "Width in metres.", gt=0.0)
    limit: float | None = option(None, "Limit in metres; unset: none.", ge=0.0, lt=1e301)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.limit is not None and self.limit < self.width:
            raise ValueError("'inner.limit' must be at least 'inner.width'")


@dataclass(frozen=True)
class Outer(CheckedOptions):
    count: Count = option(3, "how many")
    on: bool = option(False, "whether")
    name: str = option('it\'s "quoted" \\ here', "a name")
    shape: Literal["round", "square"] = option("round", "one of two")
    inner: Inner = field(default=Inner())


def refusal(changes: dict[str, Any], where: str = "file.toml") -> str:
    with pytest.raises(InputError) as caught:
        override(Outer(), changes, where)
    return str(caught.value)


def test_changes_reach_nested_sections_and_leave_the_rest() -> None:
    before = Outer(count=7)
    after = override(before, {"inner": {"limit": 4.0}, "on": True})
    assert after == Outer(count=7, on=True, inner=Inner(limit=4.0))
    assert before == Outer(count=7)


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"count": 2.0}, "'count' must be an integer, got 2.0"),
        ({"count": True}, "'count' must be an integer, got True"),
        ({"count": "2"}, "'count' must be an integer, got '2'"),
        ({"count": None}, "'count' must be an integer, got None"),
        ({"on": 1}, "'on' must be true or false, got 1"),
        ({"name": 1}, "'name' must be a text, got 1"),
        ({"shape": "oval"}, "'shape' must be 'round' or 'square', got 'oval'"),
        ({"shape": ["round"]}, "'shape' must be 'round' or 'square', got ['round']"),
        ({"inner": {"width": "1"}}, "'inner.width' must be a finite number, got '1'"),
        ({"inner": {"width": False}}, "'inner.width' must be a finite number, got False"),
        ({"inner": {"width": [1.0]}}, "'inner.width' must be a finite number, got [1.0]"),
        ({"inner": {"limit": "none"}}, "'inner.limit' must be a finite number, got 'none'"),
        ({"inner": {"width": {"a": 1}}}, "'inner.width' is a value, not a section"),
        ({"inner": 3}, "'inner' is a section, not a value"),
        ({"count": 2**31}, "'count' must be at most 2147483647, got 2147483648"),
        ({"inner": {"width": math.nan}}, "'inner.width' must be a finite number, got nan"),
        ({"inner": {"width": -math.inf}}, "'inner.width' must be a finite number, got -inf"),
        ({"inner": {"width": 10**400}}, "'inner.width' must be a finite number, got 1000"),
        ({"inner": {"width": 0.0}}, "'inner.width' must be more than 0, got 0.0"),
        ({"inner": {"limit": -1}}, "'inner.limit' must be at least 0 and less than 1e+301, got -1"),
        ({"inner": {"limit": 0.4}}, "'inner.limit' must be at least 'inner.width'"),
    ],
)
def test_a_wrong_value_is_named_with_its_file(changes: dict[str, Any], wanted: str) -> None:
    message = refusal(changes)
    assert message.startswith(f"file.toml: {wanted}")
    assert "\n" not in message


@pytest.mark.parametrize(
    ("changes", "unknown", "nearest"),
    [
        ({"counts": 1}, "counts", "count"),
        ({"inner": {"widht": 1.0}}, "inner.widht", "inner.width"),
        ({"iner": {"width": 1.0}}, "iner", "inner"),
        ({"width": 1.0}, "width", "inner.width"),
    ],
)
def test_an_unknown_key_names_the_nearest(
    changes: dict[str, Any], unknown: str, nearest: str
) -> None:
    assert refusal(changes) == f"file.toml: unknown option '{unknown}' (nearest: '{nearest}')"


def test_integers_are_taken_for_floats() -> None:
    width = override(Outer(), {"inner": {"width": 2}}).inner.width
    assert (type(width), width) == (float, 2.0)


def test_options_can_be_unset() -> None:
    set_once = Outer(inner=Inner(limit=1.0))
    assert override(set_once, {"inner": {"limit": None}}).inner.limit is None


@pytest.mark.parametrize(
    "options",
    [
        Outer(),
        Outer(4, True, "", "square", Inner(1e-300, 1e300)),
        Outer(name="tab\t newline\n ünïcode # \x7f \U0001f916"),
        Options(),
        override(Options(), {"threads": 2, "read": {"max_range": 30.0}}),
    ],
)
def test_toml_round_trip(options: Any) -> None:
    text = to_toml(options)
    assert override(type(options)(), tomllib.loads(text)) == options
    assert to_toml(override(type(options)(), tomllib.loads(text))) == text


def test_toml_has_unset_options_meanings_and_ranges() -> None:
    assert to_toml(Outer()).splitlines() == [
        "count = 3  # how many",
        "on = false  # whether",
        'name = "it\'s \\"quoted\\" \\\\ here"  # a name',
        'shape = "round"  # one of two (round | square)',
        "",
        "# The inner section.",
        "[inner]",
        "width = 0.5  # Width in metres. (more than 0)",
        "# limit is not set  # Limit in metres; unset: none. (at least 0 and less than 1e+301)",
    ]


def test_every_option_is_documented() -> None:
    assert all(len(info.doc) > 8 for info in iter_options(Options()))


def test_names_of_the_contract() -> None:
    names = {info.name for info in iter_options(Options())}
    assert {"em.max_iterations", "em.prior", "threads"} <= names
    assert len(names) <= 60


SECTIONS = {"": Options(), **vars(Options()), "slam.odometry": Options().slam.odometry}
RANGES = [
    (f"{section}.{name}".lstrip("."), key, limit)
    for section, options in SECTIONS.items()
    for name, one in declared_options(type(options)).items()
    for key, limit in one.limits.items()
    if key in {"ge", "gt", "le", "lt"}
]


@pytest.mark.parametrize(("name", "key", "limit"), RANGES)
def test_values_beyond_the_limits_are_refused(name: str, key: str, limit: float) -> None:
    value = limit + {"ge": -1, "gt": 0, "le": 1, "lt": 0}[key]
    with pytest.raises(InputError, match=f"'{name}' must be"):
        override(Options(), parse_assignment(f"{name}={value}"), "--set")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("threads=2", {"threads": 2}),
        ("em.prior=0.8", {"em": {"prior": 0.8}}),
        ("em.prior=.8", {"em": {"prior": 0.8}}),
        ("em.prior=-.8E-1", {"em": {"prior": -0.08}}),
        ("em.prior=2.", {"em": {"prior": 2.0}}),
        ("em.prior=.", {"em": {"prior": "."}}),
        (" em.prior = 0.8 ", {"em": {"prior": 0.8}}),
        (
            "slam.odometry.rotation_per_metre=1e-2",
            {"slam": {"odometry": {"rotation_per_metre": 0.01}}},
        ),
        ("output.map_mode=raw", {"output": {"map_mode": "raw"}}),
        ('output.map_mode="raw"', {"output": {"map_mode": "raw"}}),
        ("a=b=c", {"a": "b=c"}),
        ("a=true", {"a": True}),
        ("a=", {"a": ""}),
        ("a=" + "[" * 5000, {"a": "[" * 5000}),
        ("a=1\nb=2", {"a": "1\nb=2"}),
    ],
)
def test_assignments(text: str, expected: dict[str, Any]) -> None:
    assert parse_assignment(text) == expected


@pytest.mark.parametrize("text", ["em.prior", "=3", " =3", ""])
def test_malformed_assignments(text: str) -> None:
    with pytest.raises(InputError, match=r"section\.key=value"):
        parse_assignment(text)


def test_later_changes_win_and_sections_merge() -> None:
    first = {"em": {"prior": 0.5, "patience": 3}, "threads": 1}
    second = {"em": {"prior": 0.6}, "slam": {"resolution": 0.1}}
    assert merge_nested(first, second) == {
        "em": {"prior": 0.6, "patience": 3},
        "threads": 1,
        "slam": {"resolution": 0.1},
    }
    assert first == {"em": {"prior": 0.5, "patience": 3}, "threads": 1}
    assert merge_nested() == {}


def test_toml_files_that_cannot_be_used(tmp_path: Path) -> None:
    broken, binary, deep = (tmp_path / name for name in ("broken", "binary", "deep"))
    broken.write_text("threads = 1\n[em\nprior = 1")
    binary.write_bytes(b"\xff\xfe\x00")
    deep.write_text("a = " + "[" * 50_000)
    for path, said in (
        (broken, f"{broken}:2: is not TOML"),
        (binary, "is not a text file"),
        (deep, "is not TOML"),
        (tmp_path, "cannot be read"),
        (tmp_path / "absent", "cannot be read"),
    ):
        with pytest.raises(InputError, match=re.escape(said)) as caught:
            load_toml(path)
        assert str(caught.value).startswith(str(path))
