"""Values of JSON against the types that they are to have."""

from typing import Annotated, Any, Literal, NotRequired, TypedDict

import pytest

from stillmap.core.config import Limits
from stillmap.core.schema import SchemaError, check, fits, prune


class Inner(TypedDict):
    count: Annotated[int, Limits(ge=0)]
    words: NotRequired[list[str]]


class Outer(TypedDict, total=False):
    name: str
    share: Annotated[float, Limits(ge=0, le=1)] | None
    kind: Literal["a", 3]
    place: tuple[float, float]
    inner: Inner
    table: dict[str, Inner]
    some: list[Inner]
    anything: Any


RIGHT = {
    "name": "x",
    "share": 1,
    "kind": 3,
    "place": [0, 1.5],
    "inner": {"count": 2, "words": [], "other": object()},
    "table": {"k": {"count": 0}},
    "some": [{"count": 1}],
    "anything": {},
    "unknown": 1,
}


def test_what_fits():
    check(RIGHT, Outer)
    check({}, Outer)
    assert prune(RIGHT, Outer) == RIGHT


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("name", 3, "'name' must be text, got 3"),
        ("name", None, "'name' must be text, got None"),
        ("share", 1.5, "'share' must be a number or null"),
        ("share", True, "'share' must be"),
        ("share", float("nan"), "'share' must be"),
        ("kind", "b", r"'kind' must be 'a' \| 3, got 'b'"),
        ("kind", True, "'kind' must be"),
        ("place", [1], "'place' must be a list of 2"),
        ("place", [1, float("inf")], r"'place\[1\]' must be a number, got inf"),
        ("place", [1, 10**400], r"'place\[1\]' must be a number"),
        ("inner", [], "'inner' must be an object"),
        ("inner", {}, "'inner.count' is missing"),
        ("inner", {"count": -1}, "'inner.count' must be at least 0, got -1"),
        ("inner", {"count": 2**70}, "'inner.count' must be an integer"),
        ("inner", {"count": 1, "words": ["a", 2]}, r"'inner.words\[1\]' must be text, got 2"),
        ("table", {"k": {"count": 1.5}}, "'table.k.count' must be an integer"),
        ("some", {"count": 1}, "'some' must be a list"),
        ("name", ["x" * 10_000], r"got \['x{58}\.\.\.$"),
    ],
)
def test_what_does_not_fit(key, value, said):
    with pytest.raises(SchemaError, match=said):
        check({**RIGHT, key: value}, Outer)
    assert not fits({key: value}, Outer)
    left = prune({**RIGHT, key: value}, Outer)
    check(left, Outer)
    assert left.items() >= {k: v for k, v in RIGHT.items() if k != key}.items()


def test_what_is_pruned_inside():
    value = {"inner": {"count": 1, "words": [3]}, "table": {"a": {"count": 1}, "b": {}}}
    assert prune(value, Outer) == {"inner": {"count": 1}, "table": {"a": {"count": 1}}}
    assert prune({"some": [{"count": 1}, 5]}, Outer) == {}
