"""What all scores have in common: plain numbers, ready for JSON."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Scores:
    """Base of all results. NaN stands for a score that its input leaves undefined."""

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionaries of plain numbers; NaN becomes None, since JSON has no NaN."""
        return {key: _plain(value) for key, value in dataclasses.asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple):
        return [_plain(inner) for inner in value]
    return None if isinstance(value, float) and math.isnan(value) else value
