"""A tab of a headless Chromium, through its debugging protocol."""

import base64
import io
import json
import re
import shutil
import subprocess
import urllib.request

import numpy as np
import pytest
from PIL import Image

sockets = pytest.importorskip("websockets.sync.client")

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
WIDTH, HEIGHT = 1000, 700  # of the page
_FLAGS = ("--headless", "--no-sandbox", "--enable-unsafe-swiftshader", "--remote-debugging-port=0")
_KEY_NUMBERS = {"Space": 32, "PageUp": 33, "Escape": 27, "ArrowLeft": 37, "ArrowRight": 39}


class Tab:
    """A tab of a headless Chromium, and what it says happened."""

    def __init__(self, folder):
        self.process = subprocess.Popen(
            [BROWSER, *_FLAGS, f"--user-data-dir={folder}", "about:blank"],
            stderr=subprocess.PIPE,
            text=True,
        )
        port = next(
            found[1]
            for line in self.process.stderr
            if (found := re.search(r"DevTools listening on ws://[^:]+:(\d+)/", line))
        )
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
            pages = json.load(answer)
        address = next(page for page in pages if page["type"] == "page")["webSocketDebuggerUrl"]
        self.socket = sockets.connect(address, max_size=None)
        self.sent, self.events = 0, []
        for part in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{part}.enable")
        size = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def call(self, method, **words):
        self.sent += 1
        self.socket.send(json.dumps({"id": self.sent, "method": method, "params": words}))
        while True:
            answer = json.loads(self.socket.recv(timeout=60))
            if answer.get("id") == self.sent:
                return answer["result"]
            self.events.append(answer)

    def of(self, *methods):
        return [one["params"] for one in self.events if one.get("method") in methods]

    def picture(self):
        data = self.call("Page.captureScreenshot", format="png")["data"]
        return np.array(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(int)

    def value(self, expression):
        """The value of a JavaScript expression; None where it has none."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return answer["result"].get("value")

    def click(self, x, y):
        """Move the mouse to a pixel and click."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key, code):
        """Press a key and release it; key and code as in KeyboardEvent."""
        number = _KEY_NUMBERS.get(code) or ord(code[-1])
        words = {"key": key, "code": code, "windowsVirtualKeyCode": number}
        text = {"text": key} if len(key) == 1 else {}
        self.call("Input.dispatchKeyEvent", type="keyDown", **words, **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", **words)

    def close(self):
        self.socket.close()
        self.process.terminate()
        self.process.wait()
        self.process.stderr.close()
