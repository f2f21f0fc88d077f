"""The contract of a blob store: each store's tests subclass this and give a ``store`` fixture."""

import hashlib
from pathlib import Path

import pytest

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.errors import DigestMismatch, InputError, NotFound, TooLarge

BAD_NAMES = (
    "",
    "sha256:",
    "sha256:" + "0" * 63,
    "sha256:" + "0" * 65,
    "sha256:" + "A" * 64,
    "sha256:" + "0" * 64 + "\n",
    "sha256:../../../../etc/passwd",
    "../" * 20 + "etc/passwd",
    "/etc/passwd",
    "md5:" + "0" * 64,
    "sha256:" + "0" * 62 + "/.",
)
"""Names that must never reach a file system."""


def digest_of(data: bytes) -> str:
    """Digest as `hashlib` has it, independent of the store."""
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


class BlobStoreContract:
    """What every store does."""

    def test_bytes_come_back_under_their_digest(self, store: BlobStore) -> None:
        for data in (b"", b"a", b"x" * 3_000_000):
            digest = store.put_bytes(data)
            assert digest == digest_of(data)
            assert store.read_bytes(digest) == data
            assert store.size(digest) == len(data)
            assert store.local_path(digest).read_bytes() == data
            assert store.exists(digest)

    def test_the_same_bytes_are_stored_once(self, store: BlobStore) -> None:
        first, second = store.put_bytes(b"twice"), store.put_bytes(b"twice")
        assert first == second
        assert [blob.digest for blob in store.blobs()] == [first]

    def test_a_wrong_digest_is_refused_and_leaves_nothing(self, store: BlobStore) -> None:
        with pytest.raises(DigestMismatch, match=digest_of(b"right")):
            store.put_bytes(b"right", expected=digest_of(b"wrong"))
        assert not store.exists(digest_of(b"right"))
        assert list(store.blobs()) == []
        assert store.put_bytes(b"right", expected=digest_of(b"right")) == digest_of(b"right")

    def test_an_upload_beyond_its_limit_is_refused(self, store: BlobStore) -> None:
        with store.writer(max_bytes=10) as writer:
            writer.write(b"12345")
            assert writer.size == 5
            with pytest.raises(TooLarge, match="10 bytes"):
                writer.write(b"678901")
        assert list(store.blobs()) == []
        with store.writer(max_bytes=10) as writer:
            writer.write(b"1234567890")
            writer.commit()
        assert len(list(store.blobs())) == 1

    def test_an_upload_without_commit_leaves_nothing(self, store: BlobStore) -> None:
        with store.writer() as writer:
            writer.write(b"never mind")
        assert list(store.blobs()) == []

    def test_a_file_is_copied_or_given_away(self, store: BlobStore, tmp_path: Path) -> None:
        kept, given = tmp_path / "kept", tmp_path / "given"
        kept.write_bytes(b"kept")
        given.write_bytes(b"given")
        assert store.read_bytes(store.put_file(kept)) == b"kept"
        assert store.read_bytes(store.put_file(given, move=True)) == b"given"
        assert kept.exists()
        assert not given.exists()
        with pytest.raises(DigestMismatch):
            store.put_file(kept, expected=digest_of(b"other"), move=True)
        assert kept.exists()

    def test_what_is_not_there_is_not_found(self, store: BlobStore) -> None:
        missing = digest_of(b"missing")
        assert not store.exists(missing)
        assert not store.delete(missing)
        for ask in (store.open, store.read_bytes, store.size, store.local_path):
            with pytest.raises(NotFound, match=missing):
                ask(missing)

    def test_a_deleted_blob_is_gone(self, store: BlobStore) -> None:
        digest = store.put_bytes(b"short life")
        assert store.delete(digest)
        assert not store.exists(digest)
        assert store.put_bytes(b"short life") == digest

    @pytest.mark.parametrize("name", BAD_NAMES)
    def test_no_name_leads_out_of_the_store(self, store: BlobStore, name: str) -> None:
        for ask in (store.open, store.read_bytes, store.size, store.exists, store.delete):
            with pytest.raises(InputError):
                ask(name)
        with pytest.raises(InputError):
            store.put_bytes(b"x", expected=name)
        key = name.removeprefix("sha256:")
        with pytest.raises(InputError):
            store.put_result(key, {})
        with pytest.raises(InputError):
            store.get_result(key)

    def test_the_first_result_stays(self, store: BlobStore) -> None:
        key = "a" * 64
        assert store.get_result(key) is None
        assert store.put_result(key, {"value": 1}) == {"value": 1}
        assert store.put_result(key, {"value": 2}) == {"value": 1}
        assert store.get_result(key) == {"value": 1}
        assert [name for name, _ in store.results()] == [key]
        assert store.delete_result(key)
        assert not store.delete_result(key)
        assert store.get_result(key) is None

    def test_a_result_must_be_json(self, store: BlobStore) -> None:
        with pytest.raises(ValueError, match="JSON"):
            store.put_result("b" * 64, {"value": float("nan")})
        assert store.get_result("b" * 64) is None

    def test_scratch_is_lent_and_taken_back(self, store: BlobStore) -> None:
        with store.scratch() as folder, store.scratch() as other:
            assert folder != other
            assert list(folder.iterdir()) == []
            (folder / "deep").mkdir()
            (folder / "deep" / "file").write_bytes(b"x")
        assert not folder.exists()
        assert not other.exists()
