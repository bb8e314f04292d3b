"""Options of what counts as being in the robot's way."""

from dataclasses import dataclass

from stillmap.options import field_with_doc


@dataclass(frozen=True)
class BandOptions:
    """Of 3D recordings the map shows what stands in a band above the ground."""

    low: float = field_with_doc(0.2, "m above the ground from where on something is in the way")
    high: float = field_with_doc(1.8, "m above the ground up to where something is in the way")

    def __post_init__(self) -> None:
        if not 0.0 <= self.low < self.high <= 100.0:
            raise ValueError("'output.band' wants 0 <= low < high <= 100 metres")
