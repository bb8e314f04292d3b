"""Writers that do not notice a full disk are not used: half a file would pass for a whole one."""

import resource

import numpy as np
import pytest

from stillmap.core.arrays import write_npy, write_npz
from stillmap.core.files import write_text
from stillmap.core.json import write_json
from stillmap.io.cameras import write_png

ARRAY = np.random.default_rng(0).integers(0, 255, (50, 50)).astype(np.uint8)


@pytest.mark.parametrize(
    "write",
    [
        lambda path: write_npy(path, ARRAY),
        lambda path: write_npz(path, {"a": ARRAY}),
        lambda path: write_png(ARRAY, path),
        lambda path: write_text(path, "text" * 500),
        lambda path: write_json(path, ["text"] * 500),
    ],
)
def test_full_disk_is_noticed(tmp_path, write):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            write(tmp_path / "file")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
