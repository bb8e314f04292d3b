"""Options of the loop and of its estimators.

How people are found and tracked.
"""

from dataclasses import dataclass, field
from typing import Literal

from stillmap.core.config import option

# of places that changed: as they were last, or as they were for most of the time
MapState = Literal["last", "majority"]


@dataclass(frozen=True)
class TrackerOptions:
    """The tracking estimator; `docs/tracker.md` says how it works."""

    jump: float = option(0.3, "m of range between neighbouring beams: a feature's edge")
    narrowest: float = option(0.05, "m, width of a leg at least")
    widest: float = option(0.65, "m, width of a body at most")
    sigma: float = option(0.1, "m, a feature beside the middle of its person: legs swing")
    sigma_speed: float = option(1.0, "m/s, how fast people are when first seen")
    acceleration: float = option(0.5, "m2/s3, density of random acceleration")
    gate: float = option(2.5, "standard deviations within which features may be a person's")
    detection: float = option(0.9, "probability that a person in sight shows a feature")
    clutter: float = option(0.05, "features per m2 that are of nobody tracked")
    lost: float = option(1.0, "s without a feature after which a track ends")
    moved: float = option(0.5, "m from where it began: such a track is a person's")
    look: float = option(2.0, "s between scans in which a person has left its place")
    changed: float = option(
        0.2, "share of a person's features at least that stand where shortly there was nothing"
    )
    least: int = option(4, "scans with a feature that a person's track has at least")
    box: float = option(0.4, "m to each side of a person, in which beams are dropped")

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'em.tracker.{name}' wants {low:g} to {high:g}")


_LIMITS = (
    ("jump", 1e-3, 100.0),
    ("narrowest", 0.0, 100.0),
    ("widest", 0.0, 100.0),
    ("sigma", 1e-3, 100.0),
    ("sigma_speed", 1e-3, 1000.0),
    ("acceleration", 1e-6, 1e6),
    ("gate", 0.1, 100.0),
    ("detection", 0.01, 0.9999),
    ("clutter", 1e-9, 1e3),
    ("lost", 0.0, 1e6),
    ("moved", 0.0, 1000.0),
    ("look", 0.0, 1e6),
    ("changed", 0.0, 1.0),
    ("least", 1, 1_000_000),
    ("box", 0.0, 100.0),
)


@dataclass(frozen=True)
class DwellOptions:
    """The default estimator; lengths follow from the scatter of end points in the recording."""

    look: float = option(0.5, "s, beams within it tell no more of a cell than one")
    detection: float = option(0.97, "probability that an occupied cell is seen to be so")
    lateral: float = option(0.7, "scatters by which a beam may pass beside its place")
    margin: float = option(3.0, "scatters behind a surface at which a beam has passed it")
    reach: float = option(4.0, "scatters within which hits are hits of the same thing")
    beyond: float = option(0.3, "m, end of a maximum-range beam that says nothing")
    normals: bool = option(True, "know a surface seen at a slant from one seen face on")
    views: bool = option(
        True, "after the loop, know things that are met from some places only from passers-by"
    )

    def __post_init__(self) -> None:
        if not 0.01 <= self.look <= 3600.0:
            raise ValueError("'em.dwell.look' wants 0.01 to 3600 seconds")
        if not 0.5 <= self.detection <= 0.9999:
            raise ValueError("'em.dwell.detection' wants a probability from 0.5 to 0.9999")
        for name in ("lateral", "margin", "reach"):
            if not 0.0 <= getattr(self, name) <= 100.0:
                raise ValueError(f"'em.dwell.{name}' wants 0 to 100 scatters")
        if not 1e-3 <= self.beyond <= 100.0:
            raise ValueError("'em.dwell.beyond' wants 0.001 to 100 metres")


@dataclass(frozen=True)
class ChangeOptions:
    """Things that are put somewhere, taken away, or moved once."""

    enabled: bool = option(True, "look for them, and show the map in one of its states")
    stays: float = option(
        2.0, "lengths of the recording for which a thing stays, and its place stays free"
    )
    longest: float = option(3600.0, "s, the same at most")
    passing_occupied: float = option(0.05, "share of the time in which others pass there")
    passing_seconds: float = option(12.0, "s, for how long they stay")
    near: float = option(0.5, "m, cells so near to each other that change are one place")
    together: float = option(2.0, "s, by which the cells of a place may change apart")
    least: int = option(4, "cells below which a place that changed is not listed")
    in_space: bool = option(False, "list them in 3D, too, which takes more time and memory")

    def __post_init__(self) -> None:
        if not 0.01 <= self.stays <= 1000.0:
            raise ValueError("'em.changes.stays' wants 0.01 to 1000 lengths of the recording")
        for name in ("longest", "passing_seconds"):
            if not 1.0 <= getattr(self, name) <= 1e7:
                raise ValueError(f"'em.changes.{name}' wants 1 to 10000000 seconds")
        if not 0.0 < self.passing_occupied < 1.0:
            raise ValueError("'em.changes.passing_occupied' wants a share between 0 and 1")
        if not 0.0 < self.near <= 100.0:
            raise ValueError("'em.changes.near' wants more than 0 and at most 100 metres")
        if not 0.0 <= self.together <= 3600.0:
            raise ValueError("'em.changes.together' wants 0 to 3600 seconds")
        if self.least < 1:
            raise ValueError("'em.changes.least' wants at least 1")


@dataclass(frozen=True)
class BesideOptions:
    """What the voxels beside one tell of it; 3D alone, see em.beside."""

    enabled: bool = option(True, "ask about the voxels beside each")
    radius: float = option(2.5, "voxels between two that are asked about each other")
    coplanar: float = option(0.2, "voxels, standard deviation of one's mean from the other's plane")
    for_static: float = option(5.0, "nats that they are worth if all of them are static")
    for_dynamic: float = option(10.0, "nats that they are worth if none of them is")
    least: float = option(-4.0, "nats that its own looks are worth at least")
    # what was hit for ten seconds in a row is a wall, or waits
    most: float = option(3.0, "nats that its own looks are worth at most")
    moved: float = option(0.1, "change of a probability that those beside hear of")
    rounds: int = option(10, "rounds at most in which they ask each other")

    def __post_init__(self) -> None:
        if not 1.0 <= self.radius <= 8.0:
            raise ValueError("'em.beside.radius' wants 1 to 8 voxels")
        if not 0.01 <= self.coplanar <= 10.0:
            raise ValueError("'em.beside.coplanar' wants 0.01 to 10 voxels")
        for name in ("for_static", "for_dynamic"):
            if not 0.0 <= getattr(self, name) <= 100.0:
                raise ValueError(f"'em.beside.{name}' wants 0 to 100 nats")
        if not -100.0 <= self.least <= self.most <= 100.0:
            raise ValueError("'em.beside.least' and 'em.beside.most' want -100 to 100 nats, rising")
        if not 0.0 <= self.moved <= 1.0:
            raise ValueError("'em.beside.moved' wants 0 to 1")
        if not 0 <= self.rounds <= 1000:
            raise ValueError("'em.beside.rounds' wants 0 to 1000")


@dataclass(frozen=True)
class BodyOptions:
    """What stands apart in a sweep moves as a whole; 3D alone, see em.bodies."""

    enabled: bool = option(True, "ask how much of the body around each voxel moves")
    low: float = option(0.2, "m above the ground from where on things are bodies")
    high: float = option(3.0, "m above the ground up to where they are")
    foot: float = option(
        0.05, "m above the ground, and 2.5 scatters, that end points below what moves are not its"
    )
    column: float = option(0.3, "m, edge of the columns that touch within a body, to whole voxels")
    fewest: int = option(5, "voxels of a body at least, in a sweep")
    share: float = option(0.3, "mean probability to move from where on all of it does")
    change: float = option(
        1.0, "nats, mean of its voxels, by which it came to stay, or left, from where on it did"
    )
    slope: float = option(20.0, "nats for all of it, for each unit above these two")
    most: float = option(4.0, "nats for it at most")

    def __post_init__(self) -> None:
        if not -100.0 <= self.low < self.high <= 100.0:
            raise ValueError("'em.bodies.low' and 'em.bodies.high' want -100 to 100 metres, rising")
        if not 0.0 <= self.foot <= 100.0:
            raise ValueError("'em.bodies.foot' wants 0 to 100 metres")
        if not 0.01 <= self.column <= 100.0:
            raise ValueError("'em.bodies.column' wants 0.01 to 100 metres")
        if not 1 <= self.fewest <= 1_000_000:
            raise ValueError("'em.bodies.fewest' wants 1 to 1000000")
        if not 0.0 <= self.share <= 1.0:
            raise ValueError("'em.bodies.share' wants 0 to 1")
        for name in ("change", "slope", "most"):
            if not 0.0 <= getattr(self, name) <= 80.0:
                raise ValueError(f"'em.bodies.{name}' wants 0 to 80 nats")


@dataclass(frozen=True)
class EvidenceOptions:
    """What a place has to be seen by to be known; see em.evidence."""

    least: int = option(
        3, "clear looks, each of em.dwell.look: what has fewer rests on thin evidence"
    )
    near: float = option(
        0.3, "m around the end of a beam on something that moves: no clear look at what is there"
    )

    def __post_init__(self) -> None:
        if not 0 <= self.least <= 65535:
            raise ValueError("'em.evidence.least' wants 0 to 65535 looks")
        if not 0.0 <= self.near <= 5.0:
            raise ValueError("'em.evidence.near' wants 0 to 5 metres")


@dataclass(frozen=True)
class EmOptions:
    """The loop of Fig. 2."""

    prior: float = option(
        0.9, "p(c = 1), share of beams thought static before anything was learned"
    )
    max_iterations: int = option(6, "iterations at most")
    tolerance: float = option(1e-3, "nats per beam of the bound: the loop stops when it gains less")
    settled: float = option(
        0.005, "share of the hits whose label moves by 0.1: the default loop stops when fewer do"
    )
    patience: int = option(2, "iterations without a better bound before the loop stops")
    hit_ratio: float = option(
        0.25, "hits / (hits + passes) below which mappers that count drop a cell"
    )
    held_out: int = option(
        20, "every that many scans one is left out of the map and scored by it; 0: none"
    )
    dwell: DwellOptions = field(default=DwellOptions())
    changes: ChangeOptions = field(default=ChangeOptions())
    beside: BesideOptions = field(default=BesideOptions())
    bodies: BodyOptions = field(default=BodyOptions())
    evidence: EvidenceOptions = field(default=EvidenceOptions())
    tracker: TrackerOptions = field(default=TrackerOptions())

    def __post_init__(self) -> None:
        for name in ("prior", "hit_ratio"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"'em.{name}' wants a probability between 0 and 1, both excluded")
        if self.max_iterations < 1 or self.patience < 1:
            raise ValueError("'em.max_iterations' and 'em.patience' want at least 1")
        if not 0.0 <= self.settled <= 1.0:
            raise ValueError("'em.settled' wants a share between 0 and 1")
        if not self.tolerance >= 0.0:
            raise ValueError("'em.tolerance' wants a number that is not negative")
        if self.held_out < 0 or self.held_out == 1:
            raise ValueError("'em.held_out' wants 0, or 2 and more")
