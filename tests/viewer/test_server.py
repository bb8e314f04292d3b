"""Which requests the viewer answers, and its content security policy."""

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
def test_is_local_request(headers, ours):
    assert is_local_request(headers) is ours


def test_content_security_policy():
    parts = dict(
        part.split(" ", 1) for part in content_security_policy("127.0.0.1:8123").split("; ")
    )
    assert parts["connect-src"].split() == ["'self'", "data:", "blob:", "ws://127.0.0.1:8123"]
    for name in ("default-src", "script-src"):
        assert not any("://" in source or source == "*" for source in parts[name].split())
