"""Errors of prtbake, one tree.

::

    PrtError
    ├── InputError (ValueError)       the caller's data or settings; names the field or element
    │   ├── MeshError
    │   ├── EnvironmentMapError
    │   ├── BrdfError
    │   └── SettingsError
    ├── NotFound (LookupError)
    ├── Conflict
    ├── DigestMismatch (ValueError)
    ├── TooLarge (ValueError)
    ├── Unauthorised
    ├── ResourceExhausted             memory, disk or time ran out
    └── CorruptArtefact (ValueError)

``code`` is stable and goes over the wire; ``retryable`` decides whether a worker tries again;
``pointer`` is a JSON pointer to the field of the request that is at fault, where there is one.
"""

from typing import ClassVar


class PrtError(Exception):
    """Base of every error that prtbake raises on purpose."""

    code: ClassVar[str] = "internal"
    kind: ClassVar[str] = "internal"
    http_status: ClassVar[int] = 500
    retryable: ClassVar[bool] = False

    def __init__(self, detail: str, *, pointer: str | None = None) -> None:
        super().__init__(detail)
        self.detail = detail
        self.pointer = pointer


class InputError(PrtError, ValueError):
    """The caller's data or settings cannot be used."""

    code = "invalid-input"
    kind = "input"
    http_status = 400


class MeshError(InputError):
    """A mesh cannot be used."""

    code = "invalid-mesh"


class EnvironmentMapError(InputError):
    """An environment map cannot be used."""

    code = "invalid-environment"


class BrdfError(InputError):
    """A BRDF cannot be used."""

    code = "invalid-brdf"


class SettingsError(InputError):
    """Settings contradict each other or the data."""

    code = "invalid-settings"


class NotFound(PrtError, LookupError):
    """There is no such thing, or the caller may not see it."""

    code = "not-found"
    kind = "input"
    http_status = 404


class Conflict(PrtError):
    """The request is legal but not in this state."""

    code = "conflict"
    kind = "input"
    http_status = 409


class DigestMismatch(PrtError, ValueError):
    """The bytes are not those the digest names."""

    code = "digest-mismatch"
    kind = "input"
    http_status = 409


class TooLarge(PrtError, ValueError):
    """An upload exceeds the limit."""

    code = "too-large"
    kind = "input"
    http_status = 413


class Unauthorised(PrtError):
    """No valid API key."""

    code = "unauthorised"
    kind = "input"
    http_status = 401


class ResourceExhausted(PrtError):
    """Memory, disk or time ran out."""

    code = "resource-exhausted"
    kind = "resource"
    http_status = 503


class CorruptArtefact(PrtError, ValueError):
    """A stored file fails its checksum or its schema."""

    code = "corrupt-artefact"
