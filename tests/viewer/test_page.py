"""The page that the viewer serves, and to whom."""

import gzip
import socket
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from stillmap.core.errors import InputError
from stillmap.results.viewer.scene import Scene

viser = pytest.importorskip("viser", reason="the extra `viewer` is not installed")
sockets = pytest.importorskip("websockets.sync.client")

from stillmap.results.viewer import server as module  # noqa: E402
from stillmap.results.viewer.window import Window  # noqa: E402


def port_of(window):
    return urlsplit(window.url).port


def get(window, path="/", **headers):
    return get_url(window.url + path, **headers)


def get_url(url, **headers):
    return urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10)


def refuse(url):
    with pytest.raises(urllib.error.HTTPError) as caught:
        get_url(url)
    with caught.value:
        assert caught.value.code == 403


def test_page_is_served_with_its_policy(window):
    with get(window) as page:
        assert page.status == 200
        assert b"<html" in page.read()
        policy = page.headers["Content-Security-Policy"]
    assert f"connect-src 'self' data: blob: ws://127.0.0.1:{port_of(window)};" in policy


def test_page_is_for_those_who_know_its_address(window):
    """Any user of the machine reaches the port; the secret is compared in constant time."""
    root, _, token = window.url.rpartition("/")
    assert len(token) >= 32
    wrong = (token[:-1] + ("a" if token[-1] != "a" else "b"), token[:-1], token + "a", "%FF")
    paths = ("", "/", "/index.html", f"/?token={token}", f"//{token}/")
    for path in (*paths, *(f"/{one}/" for one in wrong)):
        refuse(root + path)
    foreign = urllib.request.Request(window.url + "/", headers={"Origin": "null"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(foreign, timeout=10)
    with get_url(window.url) as page:  # without a slash: a redirect
        assert page.status == 200
        assert page.url == f"{window.url}/"
        assert page.headers["Referrer-Policy"] == "no-referrer"


@pytest.mark.parametrize("packed", ["gzip", "identity"])
def test_page_has_its_script_and_its_title(window, packed):
    """It is what viser has otherwise; the script comes before all of viser's."""
    with get(window, **{"Accept-Encoding": packed}) as answer:
        page, headers = answer.read(), answer.headers
    assert int(headers["Content-Length"]) == len(page)
    assert headers["Content-Encoding"] == packed
    page = gzip.decompress(page) if packed == "gzip" else page
    first = page[page.index(b"<script") : page.index(b"</script>")]
    assert b"TONE_MAPPING" in first
    title = b"<title>walk&lt;b&gt;.bag - stillmap</title>"
    assert page.count(b"<title>") == page.count(title) == 1
    plain = (Path(viser.__file__).parent / "client/build/index.html").read_bytes()
    same = page.replace(first + b"</script>", b"").replace(title, b"<title>Viser</title>")
    assert same == plain


def test_socket_answers_only_its_page(window):
    origin = window.url.rpartition("/")[0]
    address, protocol = window.url.replace("http", "ws"), [f"viser-v{viser.__version__}"]
    for url in (address, f"{address}/"):
        with sockets.connect(url, subprotocols=protocol, origin=origin) as socket_:
            assert len(socket_.recv(timeout=10)) > 0
    with pytest.raises(Exception, match="403"):
        sockets.connect(address, subprotocols=protocol, origin="https://example.org")
    for url in (origin.replace("http", "ws"), f"{address}x"):
        with pytest.raises(Exception, match="403"):
            sockets.connect(url, subprotocols=protocol)


def test_only_loopback_answers(window):
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as one:
        # another address of loopback, which stands for those of the network
        assert one.connect_ex(("127.0.0.2", port_of(window))) != 0
    for family, *_, address in socket.getaddrinfo(socket.gethostname(), port_of(window)):
        if family == socket.AF_INET and not address[0].startswith("127."):
            with socket.socket(family, socket.SOCK_STREAM) as one:
                one.settimeout(2)
                assert one.connect_ex(address) != 0


def test_no_share_url_is_requested(window, monkeypatch):
    def refused(*_words, **_more):
        raise AssertionError("a tunnel")

    monkeypatch.setattr("viser._viser.ViserTunnel", refused)
    assert window._server.request_share_url() is None


def test_nothing_is_printed(result_of, capfd):
    window = Window(Scene(result_of(2)), None)
    window.close()
    assert capfd.readouterr() == ("", "")


def test_taken_port_is_refused(window, result_of):
    with pytest.raises(InputError, match="is taken"):
        Window(Scene(result_of(2)), None, port_of(window))


def test_unknown_viser_is_refused(result_of, monkeypatch):
    """Where its server starts otherwise than we know, it would answer anybody."""
    from contextlib import contextmanager

    @contextmanager
    def nothing(_title, _access):
        yield []

    monkeypatch.setattr(module, "_guard_servers", nothing)
    with pytest.raises(RuntimeError, match="viser"):
        Window(Scene(result_of(2)), None)


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
    assert module.is_local_request(headers) is ours
