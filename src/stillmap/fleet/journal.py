"""The journal of a fleet: one line of JSON for everything that was found out or done.

Lines are only ever appended, and each is on the disk before the run goes on. A last line that was
cut off, and any other that is damaged, is passed over: what it said is found out again.
"""

import json
from typing import Any

from stillmap.core.json import to_json
from stillmap.fleet.storage import STATE, Storage

_NAME = f"{STATE}/journal"


class Journal:
    """Append-only log of the tasks of a fleet, of earlier runs and of this one.

    Args:
        storage: where the results of the fleet lie.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._entries = [entry for line in storage.read_lines(_NAME) if (entry := _parse(line))]

    def find(self, event: str) -> list[dict[str, Any]]:
        """The entries of a kind, in order."""
        return [entry for entry in self._entries if entry["event"] == event]

    def note(self, event: str, **content: Any) -> None:
        """Append an entry.

        Raises:
            OSError, InputError: it cannot be written.
        """
        entry = {"event": event, **content}
        self._storage.append_line(_NAME, to_json(entry).encode())
        self._entries.append(entry)


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) and isinstance(found.get("event"), str) else None
