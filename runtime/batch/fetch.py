"""Downloads drives from URLs to a temporary folder while they are read."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from birdslam.sources.recording import DatasetError


def is_url(address: str) -> bool:
    """Whether the address of a source is a URL."""
    return "://" in address


@contextlib.contextmanager
def local_copy(uri: str) -> Iterator[str]:
    """Yields the URI of a local copy of a drive. Raises DatasetError if it can't be fetched."""
    scheme, _, address = uri.partition(":")
    if not is_url(address):
        yield uri
        return
    try:
        import fsspec
    except ImportError:
        raise DatasetError(f"{uri}: fetching needs fsspec: pip install 'birdslam[ray]'") from None
    with tempfile.TemporaryDirectory(prefix="birdslam-") as folder:
        place = Path(folder) / PurePosixPath(address).name
        try:
            storage, path = fsspec.core.url_to_fs(address)
            storage.get(path, str(place), recursive=bool(storage.isdir(path)))
        except Exception as error:  # each storage has its own exceptions
            reason = " ".join(str(error).split()) or type(error).__name__
            raise DatasetError(f"{uri}: can't be fetched: {reason}") from None
        yield f"{scheme}:{place}"
