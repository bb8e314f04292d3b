"""Open models with the Khronos validator, and with three.js in a browser."""

import base64
import io
import json
import shutil
import subprocess
import threading
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

HERE = Path(__file__).resolve().parent
MODULES = HERE.parents[1] / "build" / "readers" / "node_modules"
SWIFTSHADER = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def require(name, package):
    """Skip where a program or a package is missing."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"no {name}")
    if not (MODULES / package).is_dir():
        pytest.skip(f"no {package} from npm: `make build/readers` fetches it")
    return found


def validated(*paths):
    """Reports of the validator by file: issues and info."""
    node = require("node", "gltf-validator")
    words = [node, HERE / "validate_gltf.js", MODULES, *paths]
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


class _Handler(SimpleHTTPRequestHandler):
    def __init__(self, model, answer, *args):
        self.model, self.answer = model, answer
        super().__init__(*args, directory=str(MODULES.parent))

    def translate_path(self, path):
        known = {"/model.glb": self.model, "/show.html": HERE / "show_gltf.html"}
        return str(known.get(path.partition("?")[0], super().translate_path(path)))

    def do_POST(self):
        self.answer.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
        self.send_response(204)
        self.end_headers()
        self.server.done.set()

    def log_message(self, *_):
        pass


@contextmanager
def _served(model, answer):
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, model, answer))
    server.done = threading.Event()
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def shown(path, place, towards, folder, size=(600, 400)):
    """(h, w, 3) uint8, a model drawn by three.js from a place, y up, 60 degrees field of view."""
    browser = require("chromium", "three")
    numbers = {"from": place, "to": towards, "size": size}
    asked = "&".join(f"{k}={','.join(map(str, v))}" for k, v in numbers.items())
    answer = []
    with _served(path, answer) as server:
        url = f"http://127.0.0.1:{server.server_port}/show.html?{asked}"
        words = [browser, "--headless", "--no-sandbox", *SWIFTSHADER, f"--user-data-dir={folder}"]
        with subprocess.Popen([*words, url], stderr=subprocess.DEVNULL) as process:
            try:
                assert server.done.wait(120), "the browser does not answer"
            finally:
                process.terminate()
    assert answer[0].startswith("data:image/png;base64,"), answer[0][:500]
    data = base64.b64decode(answer[0].partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
