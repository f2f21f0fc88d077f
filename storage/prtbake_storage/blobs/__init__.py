"""Content-addressed storage of bytes."""

from prtbake_storage.blobs.base import BlobInfo, BlobStore, BlobWriter, check_digest
from prtbake_storage.blobs.garbage import GarbageReport, collect_garbage
from prtbake_storage.blobs.local import LocalBlobStore
from prtbake_storage.blobs.opening import open_store

__all__ = [
    "BlobInfo", "BlobStore", "BlobWriter", "GarbageReport", "LocalBlobStore", "check_digest",
    "collect_garbage", "open_store",
]  # fmt: skip
