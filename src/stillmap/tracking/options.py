"""Options of the tracking of moving objects."""

from pydantic.dataclasses import dataclass

from stillmap.core.config import STRICT, option


@dataclass(frozen=True, config=STRICT)
class ObjectOptions:
    """Tracking of moving objects; see `docs/objects.md`."""

    enabled: bool = option(True, "Detect and track moving objects.")
    min_extent: float = option(
        0.15, "Minimum extent of an object plus its path, in metres.", ge=0.0, le=1000.0
    )
