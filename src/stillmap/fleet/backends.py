"""The storage of a fleet by its path or URL."""

from stillmap.fleet.bucket import BucketStorage
from stillmap.fleet.storage import FolderStorage, Storage
from stillmap.fleet.urls import is_url


def open_storage(root: str) -> Storage:
    """The storage at a path or URL; nothing is created yet.

    Raises:
        InputError: the URL is of a kind that is not supported.
        MissingExtra: the library for it is not installed.
    """
    return BucketStorage(root) if is_url(root) else FolderStorage(root)
