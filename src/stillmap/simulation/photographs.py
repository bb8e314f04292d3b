"""Pictures of a simulated world: rendered when they are read, each the same however often."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.images import Camera, Images
from stillmap.simulation import camera, colours, picture
from stillmap.simulation.camera import Shots
from stillmap.simulation.colours import Spot
from stillmap.simulation.picture import NOTHING, Lens, Shown
from stillmap.simulation.solids import Solids
from stillmap.simulation.spatial import World
from stillmap.simulation.surfaces import to_local

Float = NDArray[np.float64]
Colour = NDArray[np.uint8]

SKY = 65535  # in masks: nothing there
MOST_MOVERS = SKY - 1


class Photograph(NamedTuple):
    """One picture and its truth.

    Attributes:
        colour: (h, w, 3) uint8.
        mask: (h, w) uint16, 0: something that stands still, k + 1: mover k, `SKY`: nothing.
        distance: (h, w) float32 metres along the pixel's ray; inf where nothing is.
    """

    colour: Colour
    mask: NDArray[np.uint16]
    distance: NDArray[np.float32]


class Photographs:
    """All pictures that the cameras of a world take.

    Attributes:
        images: as a recording has them.
        T_world_camera: (N, 4, 4) from where each was taken.
        colour_seed: of what they look like.
    """

    def __init__(self, world: World) -> None:
        happening, o = world.happening, world.happening.scene.camera
        if happening.colour_seed is None:
            raise ValueError("the scene has no camera")
        self._world, self._options, self.colour_seed = world, o, happening.colour_seed
        self._shots = Shots.of(happening, o)
        cameras = camera.cameras(o)
        # all alike
        self._lenses = [_lens(cameras[0], *offset) for offset in _within_a_pixel(o.antialias)]
        T_base_camera = np.stack([c.T_base_camera for c in cameras if c.T_base_camera is not None])
        moment = world.moment(self._shots.scan, self._shots.seconds)
        self.T_world_camera = world.T_world_base(moment) @ T_base_camera[self._shots.camera]
        self.images = Images(self._shots.stamp_ns, self._shots.camera, cameras, self._colours)

    def __len__(self) -> int:
        return len(self.images)

    def take(self, image: int) -> Photograph:
        """One picture with its truth.

        With several rays for each pixel, one that a mover touches is his, and the nearest of its
        distances counts.
        """
        moving = self._moving(image)
        parts = [self._rendered(lens, self.T_world_camera[image], moving) for lens in self._lenses]
        mask, distance = parts[0].mask, parts[0].distance
        total = parts[0].colour.astype(np.float64)
        for one in parts[1:]:
            theirs = (mask == 0) | ((mask == SKY) & (one.mask != 0))
            mask = np.where(theirs & (one.mask != SKY), one.mask, mask)
            distance = np.minimum(distance, one.distance)
            total += one.colour
        return Photograph(self._developed(total / len(parts), image), mask, distance)

    def _colours(self, image: int) -> Colour:
        return self.take(image).colour

    def _moving(self, image: int) -> Solids:
        scan = int(self._shots.scan[image])
        moment = self._world.moment(np.array([scan]), self._shots.seconds[image : image + 1])
        return self._world.carried.at(moment, scan)

    def _rendered(self, lens: Lens, T_world_camera: Float, moving: Solids) -> Photograph:
        world, R = self._world, T_world_camera[:3, :3]
        ceiling = world.happening.scene.heights.ceiling
        seen = picture.shown(
            lens, T_world_camera, world.faces, world.still, moving, world.ground, ceiling
        )
        direction = np.einsum("ij,jhw->hwi", R, lens.direction)
        colour = np.empty((*seen.part.shape, 3), np.uint8)
        sky, static = seen.part == NOTHING, seen.part == picture.STATIC
        colour[sky] = colours.sky_colour(direction[sky])
        range = seen.range[static]
        places = T_world_camera[:3, 3] + range[:, None] * direction[static]
        colour[static] = colours.static_colour(places, self.colour_seed, range / lens.K[0, 0])
        self._paint_movers(colour, seen, T_world_camera[:3, 3], direction, moving)
        mask = np.zeros(seen.part.shape, np.uint16)
        mask[sky] = SKY
        moves = seen.part >= 0
        mask[moves] = moving.mover[seen.part[moves]] + 1
        return Photograph(colour, mask, seen.range.astype(np.float32))

    def _paint_movers(
        self, colour: Colour, seen: Shown, at: Float, direction: Float, moving: Solids
    ) -> None:
        kinds = self._world.happening.motion.kinds
        for k in np.unique(seen.part[seen.part >= 0]).tolist():
            pixels, mover = seen.part == k, int(moving.mover[k])
            p = at + seen.range[pixels][:, None] * direction[pixels]
            part = (int(moving.form[k]), moving.half[k], moving.z[k])
            spot = Spot(mover, *part, to_local(p, moving.pose[0, k]), self.colour_seed)
            colour[pixels] = colours.mover_colour(kinds[mover], spot)

    def _developed(self, colour: Float, image: int) -> Colour:
        """With the exposure and the noise of this picture."""
        rng = np.random.default_rng((self.colour_seed, image))
        o = self._options
        gain = np.exp(o.exposure * rng.standard_normal())
        noise = o.noise * rng.standard_normal(colour.shape, dtype=np.float32)
        out: Colour = np.clip(np.rint(gain * colour + noise), 0, 255).astype(np.uint8)
        return out


def _lens(one: Camera, right: float, down: float) -> Lens:
    assert one.K is not None
    return Lens.of(camera.looking(one, right, down), one.K)


def _within_a_pixel(n: int) -> list[tuple[float, float]]:
    """Pixels beside its centre, of n x n rays."""
    steps = ((np.arange(n) + 0.5) / n - 0.5).tolist()
    return [(right, down) for down in steps for right in steps]
