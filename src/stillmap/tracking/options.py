"""Options of the tracking of moving objects."""

from dataclasses import dataclass

from stillmap.core.config import Section, option


@dataclass(frozen=True)
class ObjectOptions(Section, section="objects"):
    """Tracking of moving objects; see `docs/objects.md`."""

    enabled: bool = option(True, "Detect and track moving objects.")
    min_extent: float = option(
        0.15, "Minimum extent of an object plus its path, in metres.", ge=0.0, le=1000.0
    )
