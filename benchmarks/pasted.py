"""Somebody walks through a static RGB-D recording: pasted into its depth and its colours.

    python benchmarks/pasted.py FOLDER OUT [--seed 0] [--people 2]

FOLDER is one of frames (`frame-NNNNNN.color`, `.depth.png`, `.pose.txt`, `camera-intrinsics.txt`,
as 7-Scenes has them) whose world's y points down. OUT becomes one of the same kind, and
`OUT/truth/frame-NNNNNN.png` says which pixels of the colours show somebody: 0 nobody, k + 1 walker
k. Walkers are upright ellipsoids in strong colours, 1.7 m tall, who walk to and fro between the
camera and what it looks at.
"""

import argparse
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Float = NDArray[np.float64]

_MILLIMETRES = 1000.0
_NOISE = 2.85e-3  # 1/m: an RGB-D camera's depth is off by this times the depth squared
_FRAMES_PER_SECOND = 30.0
_SPEED = 0.7  # m/s
_HALF = ((0.22, 0.55, 0.18), (0.11, 0.14, 0.12))  # m, of trunk and head
_ABOVE = (0.85, 1.56)  # m above the floor, their middles
_COLOURS = np.array(
    [[230, 40, 160], [40, 220, 60], [250, 200, 20], [30, 60, 230], [240, 90, 20], [20, 210, 220]]
)


class Walker(NamedTuple):
    """Goes to and fro between two places (3,) on the floor, in the frame of the world."""

    one: Float
    other: Float
    start: float  # s
    colours: NDArray[np.int64]

    def at(self, seconds: float) -> Float:
        """(3,) where it stands."""
        length = float(np.linalg.norm(self.other - self.one))
        gone = (seconds + self.start) * _SPEED / length % 2.0
        return np.asarray(self.one + (1.0 - abs(gone - 1.0)) * (self.other - self.one))


def walkers(poses: Float, floor: float, people: int, rng: np.random.Generator) -> list[Walker]:
    """Across what the cameras (T, 4, 4) look at, 0.8 to 1.4 m before them."""
    middle, ahead = poses[:, :3, 3].mean(axis=0), poses[:, :3, 2].mean(axis=0)
    ahead[1] = 0.0
    ahead /= np.linalg.norm(ahead)
    aside = np.array([ahead[2], 0.0, -ahead[0]])
    out = []
    for _ in range(people):
        at = middle + rng.uniform(0.8, 1.4) * ahead
        at[1] = floor
        reach, slant = rng.uniform(0.9, 1.3), rng.uniform(-0.2, 0.2)
        way = reach * aside + slant * ahead
        colours = rng.permutation(len(_COLOURS))[:3]
        out.append(Walker(at - way, at + way, rng.uniform(0.0, 10.0), _COLOURS[colours]))
    return out


def pasted(
    picture: NDArray[np.uint8],
    depth: Float,
    rays: Float,
    T_world_camera: Float,
    who: list[Walker],
    seconds: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.uint8], Float, NDArray[np.uint8]]:
    """Colours (h, w, 3), depth (h, w) in metres and walkers (h, w) with somebody in them.

    Where the depth is not known (0) whoever is there is nearer.
    """
    picture, depth = picture.copy(), depth.copy()
    shown = np.zeros(depth.shape, np.uint8)
    far = np.where(depth > 0.0, depth, np.inf)
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    direction = rays @ R.T
    for k, one in enumerate(who):
        for half, above in zip(_HALF, _ABOVE, strict=True):
            middle = one.at(seconds) - [0.0, above, 0.0]
            scale = 1.0 / np.array(half)
            start, along = (t - middle) * scale, direction * scale
            a, b = (along**2).sum(axis=-1), along @ start
            inside = b**2 - a * (start @ start - 1.0)
            away = (-b - np.sqrt(np.maximum(inside, 0.0))) / a  # along rays whose z is 1: depth
            meets = (inside > 0.0) & (away > 0.3) & (away < far)
            at = direction[meets] * away[meets, None] + t - middle
            stripe = np.floor(at[:, 1] / 0.12).astype(int) + np.floor(
                2.0 * np.arctan2(at[:, 2], at[:, 0])
            ).astype(int)
            light = (
                0.75
                + 0.25 * -(at * scale**2 / np.linalg.norm(at * scale**2, axis=1)[:, None])[:, 1]
            )
            picture[meets] = (one.colours[stripe % 3] * light[:, None]).clip(0, 255)
            far[meets] = away[meets]
            depth[meets] = away[meets] + _NOISE * away[meets] ** 2 * rng.normal(size=meets.sum())
            shown[meets] = k + 1
    return picture, depth, shown


def paste(folder: Path, out: Path, seed: int, people: int) -> float:
    """Makes the folder; returns the share of pictures that show somebody on 1 % of their pixels."""
    rng = np.random.default_rng(seed)
    frames = sorted(path.name.split(".")[0] for path in folder.glob("*.pose.txt"))
    poses = np.stack([np.loadtxt(folder / f"{name}.pose.txt") for name in frames])
    K = np.loadtxt(folder / "camera-intrinsics.txt")
    (out / "truth").mkdir(parents=True)
    shutil.copy(folder / "camera-intrinsics.txt", out)
    who, shows = walkers(poses, poses[:, 1, 3].mean() + 1.3, people, rng), 0
    for name, T in zip(frames, poses, strict=True):
        depth = np.asarray(Image.open(folder / f"{name}.depth.png"), np.float64) / _MILLIMETRES
        depth[depth > 65.0] = 0.0
        colour = next(folder.glob(f"{name}.color.*"))
        picture = np.asarray(Image.open(colour).convert("RGB"))
        row, column = np.indices(depth.shape)
        rays = np.stack([column, row, np.ones(depth.shape)], axis=-1) @ np.linalg.inv(K).T
        seconds = int(name.split("-")[1]) / _FRAMES_PER_SECOND
        picture, depth, shown = pasted(picture, depth, rays, T, who, seconds, rng)
        shows += bool((shown > 0).mean() >= 0.01)
        Image.fromarray(picture).save(out / f"{name}.color.png", compress_level=1)
        millimetres = np.round(depth * _MILLIMETRES).astype(np.uint16)
        Image.fromarray(millimetres).save(out / f"{name}.depth.png", compress_level=1)
        Image.fromarray(shown).save(out / "truth" / f"{name}.png", compress_level=1)
        shutil.copyfile(folder / f"{name}.pose.txt", out / f"{name}.pose.txt")
    return shows / max(len(frames), 1)


def main() -> None:
    """Pastes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--people", type=int, default=2)
    args = parser.parse_args()
    share = paste(args.folder, args.out, args.seed, args.people)
    print(f"{100.0 * share:.0f} % of the pictures show somebody")


if __name__ == "__main__":
    main()
