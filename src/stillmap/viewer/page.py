"""What is changed of viser's page before it is sent."""

import gzip
from typing import Any

_HEAD = b"<head>"
# viser gives no choice: what its meshes are drawn with goes through a film's curve (ACES), which
# darkens and greys what was photographed. three.js asks for it by a word in each shader.
_AS_THEY_ARE = b"""<script>{
  const drawing = WebGL2RenderingContext.prototype, plain = drawing.shaderSource;
  drawing.shaderSource = function (shader, text) {
    plain.call(this, shader, text.replace("#define TONE_MAPPING", ""));
  };
}</script>"""


def show_as_they_are(response: Any) -> None:
    """Let a page of viser's show colours as they were sent; anything else is left as it is.

    Args:
        response: of `websockets`, with `headers` and `body`; both are changed.
    """
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    packed = response.headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(response.body) if packed else response.body
    body = body.replace(_HEAD, _HEAD + _AS_THEY_ARE, 1)
    response.body = gzip.compress(body, 6) if packed else body
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
