"""Results as artifacts: each has a label with the key of what it was made from.

The key is a hash of the content of the recording, the options and the version of stillmap. The
label also has the hash of the result's `run.json`: a result that was replaced or changed since then
does not fit its label.
"""

import hashlib
import json
from collections.abc import Sequence
from typing import Any

from stillmap.core.version import package_version
from stillmap.fleet.settings import Settings
from stillmap.fleet.storage import RECORD, STATE, Storage

RESULTS, PLACES = "results", "places"  # folders of the fleet


def key_of(task: str, content: Sequence[str], settings: Settings) -> str:
    """The key of a result.

    Args:
        task: "map" or "merge".
        content: digests of the recordings, or the keys of the results that are merged.
        settings: of the task.
    """
    text = json.dumps([task, list(content), settings.describe(), package_version()])
    return hashlib.sha256(text.encode()).hexdigest()


def write_label(
    storage: Storage, name: str, key: str, record: bytes, content: dict[str, Any]
) -> None:
    """Label a result that is about to be published.

    Args:
        storage: where the result lies.
        name: of the result, with its folder: `results/NAME`.
        key: see `key_of`.
        record: the content of its `run.json`.
        content: further entries of the label.
    """
    label = {**content, "key": key, "record": hashlib.sha256(record).hexdigest()}
    text = json.dumps({"checksum": _checksum(label), "label": label}, indent=1)
    storage.write(_label_of(name), text.encode())


def find_result(storage: Storage, name: str, key: str) -> dict[str, Any] | None:
    """The label of a result that is there, whole and made from what `key` says; else None."""
    text = storage.read(_label_of(name))
    try:
        found = json.loads(text or b"null")
        label, checksum = found["label"], found["checksum"]
    except (ValueError, RecursionError, TypeError, KeyError):
        return None
    if not isinstance(label, dict) or _checksum(label) != checksum or label.get("key") != key:
        return None
    record = storage.read(f"{name}/{RECORD}")
    if record is None or hashlib.sha256(record).hexdigest() != label.get("record"):
        return None
    return label


def _checksum(label: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(label, sort_keys=True).encode()).hexdigest()


def _label_of(name: str) -> str:
    return f"{STATE}/labels/{name}.json"
