"""One URL names a blob store."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.blobs.local import LocalBlobStore
from prtbake_storage.errors import SettingsError


def open_store(url: str, *, owner: str = "local", incoming: Path | None = None) -> BlobStore:
    """Open the store that a URL (``file:///...``) or a plain path names.

    ``owner`` and ``incoming`` say where this process leaves unfinished files (`LocalBlobStore`).
    """
    parts = urlsplit(url)
    if parts.scheme == "file":
        if parts.netloc not in ("", "localhost"):
            raise SettingsError(f"blob_url names another host: {url}", pointer="/blob_url")
        return LocalBlobStore(Path(unquote(parts.path)), owner=owner, incoming=incoming)
    if parts.scheme or not url:
        raise SettingsError(
            f"blob_url must be file:///directory or a path, not {url!r}", pointer="/blob_url"
        )
    return LocalBlobStore(Path(url), owner=owner, incoming=incoming)
