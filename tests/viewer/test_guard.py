"""Which requests are answered, and what the page may reach."""

import pytest

from stillmap.viewer.server import content_security_policy, is_local_request


@pytest.mark.parametrize(
    ("headers", "ours"),
    [
        ({"Host": "127.0.0.1:8123"}, True),
        ({"Host": "localhost:8123"}, True),
        ({"Host": "127.0.0.1"}, True),
        ({"Host": "127.0.0.1:8123", "Origin": "http://127.0.0.1:8123"}, True),
        ({"Host": "127.0.0.1:8123", "Origin": "http://localhost:8123"}, False),
        ({"Host": "127.0.0.1:8123", "Origin": "http://127.0.0.1:3000"}, False),
        ({"Host": "127.0.0.1:8123", "Origin": "https://example.org"}, False),
        ({"Host": "127.0.0.1:8123", "Origin": "null"}, False),
        ({"Host": "example.org:8123", "Origin": "http://example.org:8123"}, False),
        ({"Host": "127.0.0.1.example.org:8123"}, False),
        ({"Host": "localhost:8123; x"}, False),
        ({}, False),
    ],
)
def test_only_this_page_is_answered(headers, ours):
    assert is_local_request(headers) is ours


def test_the_page_may_reach_nothing_but_where_it_came_from():
    parts = dict(
        part.split(" ", 1) for part in content_security_policy("127.0.0.1:8123").split("; ")
    )
    assert parts["connect-src"].split() == ["'self'", "data:", "blob:", "ws://127.0.0.1:8123"]
    for name in ("default-src", "script-src"):
        assert not any("://" in source or source == "*" for source in parts[name].split())
