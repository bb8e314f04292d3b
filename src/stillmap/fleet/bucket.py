"""Recordings and results in S3 buckets, through s3fs; needs the extra `s3`.

The endpoint is AWS_ENDPOINT_URL; keys and region come from the usual variables and files.
"""

import json
import os
import re
import secrets
import stat
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from stillmap.core.errors import InputError, import_extra
from stillmap.fleet.scratch import make_folder, remove_stale, scratch_folder
from stillmap.fleet.storage import RECORD, STATE, UnreachableError

_RETRIES = {"max_attempts": 5, "mode": "standard"}
_TIMEOUT = 10  # s for a connection
_lock = threading.Lock()


class RemoteFile(NamedTuple):
    """A file in a bucket.

    Attributes:
        name: relative to the listed URL; empty for the URL itself.
        size: bytes.
        version: its ETag, which differs where the content does.
    """

    name: str
    size: int
    version: str


class BucketStorage:
    """A prefix in a bucket. An object appears whole; a result counts from its `run.json` on."""

    def __init__(self, root: str) -> None:
        self.root = root.rstrip("/")
        self._s3 = _connect(self.root)

    def read(self, name: str) -> bytes | None:
        with explain(self._url(name), "read"):
            try:
                return bytes(self._s3.cat_file(self._url(name)))
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes) -> None:
        with explain(self._url(name), "written"):
            self._s3.pipe_file(self._url(name), content)

    def read_lines(self, folder: str) -> list[bytes]:
        names = [one.name for one in list_files(self._url(folder))]
        with explain(self._url(folder), "read"):
            found = self._s3.cat([f"{self._url(folder)}/{name}" for name in names]) if names else {}
        if isinstance(found, bytes):  # of a single file
            return [found]
        return [content for _, content in sorted(found.items())]

    def append_line(self, folder: str, line: bytes) -> None:
        # objects cannot grow: one for each line, in the order of their names
        self.write(f"{folder}/{time.time_ns():020d}-{secrets.token_hex(4)}.json", line)

    def is_taken(self) -> bool:
        with explain(self.root, "read"):
            if not self._s3.exists(self.root):
                return False
            found = [str(path).rstrip("/") for path in self._s3.ls(self.root, detail=False)]
            return any(not path.endswith(f"/{STATE}") for path in found)

    @contextmanager
    def attempt(self) -> Iterator[Path]:
        with local_scratch() as path:
            yield path

    def publish(self, folder: Path, name: str) -> None:
        url = self._url(name)
        self._remove(url)
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        paths.sort(key=lambda path: path == folder / RECORD)
        with explain(url, "written"):
            first, last = paths[:-1], paths[-1]
            names = [path.relative_to(folder).as_posix() for path in first]
            self._s3.put([str(path) for path in first], [f"{url}/{one}" for one in names])
            self._s3.put_file(str(last), f"{url}/{last.relative_to(folder).as_posix()}")

    def local_folder(self, name: str, attempt: Path) -> Path:
        return fetch(self._url(name), attempt)

    def remove_unfinished(self) -> None:
        remove_stale(_scratch_parent())

    def _remove(self, url: str) -> None:
        """Remove a result, its record first, and what interrupted uploads left of it."""
        names = [one.name for one in list_files(url)]
        with explain(url, "written"):
            if RECORD in names:
                self._s3.rm_file(f"{url}/{RECORD}")
            if names:
                self._s3.rm([f"{url}/{name}" for name in names if name != RECORD])
            bucket, _, prefix = url.removeprefix("s3://").partition("/")
            found = self._s3.call_s3("list_multipart_uploads", Bucket=bucket, Prefix=f"{prefix}/")
            for one in found.get("Uploads", ()):
                key, upload = one["Key"], one["UploadId"]
                self._s3.call_s3("abort_multipart_upload", Bucket=bucket, Key=key, UploadId=upload)

    def _url(self, name: str) -> str:
        return f"{self.root}/{name}"


def list_files(url: str) -> list[RemoteFile]:
    """The files at and below a URL, by name; empty where there is nothing.

    Raises:
        InputError: the bucket cannot be read.
    """
    s3 = _connect(url)
    with explain(url, "read"):
        try:
            found = s3.find(url, detail=True)
        except FileNotFoundError as error:
            bucket = url.split("/", 3)[2]
            if not s3.exists(bucket):
                raise InputError("there is no such bucket", where=f"s3://{bucket}") from error
            return []
    root = url.removeprefix("s3://").rstrip("/")
    files = (
        RemoteFile(path.removeprefix(root).lstrip("/"), int(about["size"]), str(about["ETag"]))
        for path, about in found.items()
        if about["type"] == "file" and not path.endswith("/")
    )
    return sorted(one for one in files if not _leaves(one.name))


def expand_pattern(url: str) -> list[str]:
    """The URLs of the files and folders that match a pattern, by name."""
    with explain(url, "read"):
        return [f"s3://{path.rstrip('/')}" for path in sorted(_connect(url).glob(url))]


def fetch(url: str, folder: Path) -> Path:
    """Copy the file or the tree at a URL into a local folder, through fsspec's simplecache.

    Args:
        url: of a recording or a result.
        folder: keeps its bucket and path: `folder/BUCKET/...`.

    Returns:
        The local path, which ends with the same name.

    Raises:
        InputError: there is nothing, or it cannot be read.
    """
    fsspec = import_extra("fsspec", url, group="s3")
    files = list_files(url)
    if not files:
        raise InputError("does not exist", where=url)
    target = local_path(url, folder)
    by_folder: dict[PurePosixPath, list[str]] = {}
    for one in files:
        path = PurePosixPath(url.removeprefix("s3://")) / one.name
        by_folder.setdefault(path.parent, []).append(f"simplecache::s3://{path}")
    with explain(url, "read"):
        for parent, urls in by_folder.items():
            cached = {"cache_storage": str(folder / parent), "same_names": True}
            fsspec.open_local(urls, simplecache=cached, s3=_settings())
    return target


def local_path(url: str, folder: Path) -> Path:
    """Where `fetch` puts a URL."""
    return folder / url.removeprefix("s3://").rstrip("/")


@contextmanager
def local_scratch() -> Iterator[Path]:
    """A temporary folder of this machine; those of killed processes are removed first."""
    parent = _scratch_parent()
    remove_stale(parent)
    with scratch_folder(parent) as path:
        yield path
    remove_stale(parent)


@contextmanager
def explain(url: str, action: str) -> Iterator[None]:
    """Turn errors of S3 into one line.

    Raises:
        InputError: there is no access, or nothing there.
        UnreachableError: whatever else s3fs, botocore or the network raised.
    """
    try:
        yield
    except InputError:
        raise
    except PermissionError as error:
        hint = "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_PROFILE decide"
        raise InputError(f"cannot be {action}: no access", where=url, hint=hint) from error
    except FileNotFoundError as error:
        raise InputError("does not exist", where=url) from error
    except Exception as error:
        if not _is_of_s3(error):
            raise
        what = re.sub(r"\s+", " ", str(error)) or type(error).__name__
        what = re.sub(r"\?[^\s\"]*", "", what)  # the query of a URL
        raise UnreachableError(f"cannot be {action}: {what}", where=url) from error


def _is_of_s3(error: Exception) -> bool:
    """Whether an error comes from the storage, the network or its settings."""
    module = type(error).__module__.partition(".")[0]
    return isinstance(error, OSError) or module in ("botocore", "aiobotocore", "aiohttp", "fsspec")


@cache
def _open_s3(settings: str) -> Any:
    s3fs = import_extra("s3fs", "s3://", group="s3")
    return s3fs.S3FileSystem(**json.loads(settings))


def _connect(url: str) -> Any:
    import_extra("s3fs", url, group="s3")
    with _lock:
        return _open_s3(json.dumps(_settings()))


def _settings() -> dict[str, Any]:
    """Settings of s3fs: listings are never remembered, others may write meanwhile."""
    config = {"retries": _RETRIES, "connect_timeout": _TIMEOUT}
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    return {
        "use_listings_cache": False,
        "config_kwargs": config,
        **({"endpoint_url": endpoint} if endpoint else {}),
    }


def _scratch_parent() -> Path:
    """The folder of temporary copies, this user's alone.

    Raises:
        InputError: it belongs to somebody else.
    """
    path = Path(tempfile.gettempdir()) / f"stillmap-fleet-{os.getuid()}"
    found = make_folder(path, 0o700)
    if stat.S_ISLNK(found.st_mode) or found.st_uid != os.getuid():
        raise InputError("belongs to somebody else", where=str(path), hint="TMPDIR decides")
    return path


def _leaves(name: str) -> bool:
    """Whether a name would lead out of the folder it is written to."""
    return any(part in ("", ".", "..") for part in name.split("/")) and name != ""
