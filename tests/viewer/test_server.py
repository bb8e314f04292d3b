"""Which requests the viewer answers, and its content security policy."""

import pytest

from stillmap.results.viewer.server import is_local_request


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
