"""Options of the tracking of moving objects."""

from dataclasses import dataclass

from stillmap.core.config import Section, option


@dataclass(frozen=True)
class ObjectOptions(Section, section="objects"):
    """Tracking of moving objects; see `docs/objects.md`."""

    enabled: bool = option(True, "Detect and track moving objects.")
    min_p_dynamic: float = option(
        0.7, "Minimum P(dynamic) of a beam to belong to a moving object.", ge=0.0, le=1.0
    )
    max_gap: float = option(
        2.0,
        "Time in seconds after which a track without detections is terminated.",
        ge=0.0,
        le=1000.0,
    )
    min_extent: float = option(
        0.15, "Minimum extent of an object plus its path, in metres.", ge=0.0, le=1000.0
    )
