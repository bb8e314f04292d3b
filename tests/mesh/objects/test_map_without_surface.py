"""Recordings of which no surface can be made are mapped all the same."""

import dataclasses
import json

import numpy as np

from stillmap.cli.main import main
from stillmap.io import stillmap_folder


def test_a_few_lonely_points(room, tmp_path):
    recording = stillmap_folder.read(room)
    hit = np.zeros(recording.n_beams, bool)
    hit[:: len(hit) // 20] = recording.hit[:: len(hit) // 20]
    stillmap_folder.write(dataclasses.replace(recording, hit=hit, images=None), tmp_path / "sim")
    out, truth = tmp_path / "out", room / "truth/trajectory.tum"
    words = ["map", tmp_path / "sim", "-o", out, "--mesh", "--poses", truth, "--threads", "1"]
    assert main([str(word) for word in words]) == 0
    record = json.loads((out / "run.json").read_text())
    assert record["models"]["faces"] == record["models"]["area"] == 0
    assert any(one.startswith("no mesh of the place") for one in record["warnings"])
    assert not (out / "mesh.glb").exists()
    assert (out / "static.ply").exists()
