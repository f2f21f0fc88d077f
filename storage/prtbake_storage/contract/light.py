"""Settings of a light that is fitted: its functions, and what may bound them."""

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from prtbake_storage.contract.base import MaxBytes, MaxError, MaxSeconds, Positive, Wire
from prtbake_storage.decode.light import LightMethod
from prtbake_storage.decode.sh import MOST_ORDER

LIGHT_OWNERS: dict[str, LightMethod] = {
    "max_error": "srbf_scattered",
    "max_bytes": "srbf_scattered",
    "max_seconds": "srbf_scattered",
    "n_lobes": "srbf_scattered",
    "max_iterations": "srbf_scattered",
    "n_centres": "srbf_uniform",
    "bandwidth": "srbf_uniform",
    "sh_order": "sh",
    "resolution": "wavelet",
    "n_wavelets": "wavelet",
}
"""Settings of a light that go with one method alone."""

LIGHT_SIZES = {
    "n_lobes": 162,
    "max_iterations": 6,
    "n_centres": 162,
    "sh_order": 18,
    "resolution": 64,
    "n_wavelets": 324,
}
"""Of these where a request says nothing: 162 scattered lobes, 324 harmonics and 324 wavelets are
972 numbers each."""

MOST_LOBES = 2000
LOBES_TO_TARGET = 642
"""At most, where a request gives an error in place of a number of lobes."""


MOST_BANDWIDTH = 600 / 642
"""Of uniform lobes, over how many there are: ten times the default.  Amid three centres every
function has sunk to 7 % of its peak there, and integrals have to be cut ever finer."""


class FitLightSettings(Wire):
    """An environment as a sum of few functions.

    Scattered Gaussian SRBFs (``srbf_scattered``) have centres and bandwidths of their own, six
    numbers a lobe; SRBFs at the points of an icosphere (``srbf_uniform``), spherical harmonics
    (``sh``) and the largest Haar wavelets of a cube map (``wavelet``) three a function.  Fields of
    one method are refused with another.  With ``max_error`` the lobes are as many as that asks for;
    where ``n_lobes`` leave more, the job fails and tells what they leave.
    """

    method: LightMethod = "srbf_scattered"
    max_error: MaxError | None = None
    """Of `srbf_scattered`: what the light may leave of the environment, squared and relative."""
    max_bytes: MaxBytes | None = None
    """Of `srbf_scattered`: of `light.h5`; as many lobes as fit it, or with `max_error` at most."""
    max_seconds: MaxSeconds | None = None
    """Of `srbf_scattered`: refinement ends in time with what it has, and a note says so; with
    `max_error` the job fails where that leaves more."""
    n_lobes: Annotated[int, Field(ge=1, le=MOST_LOBES)] | None = Field(
        default=None, validate_default=True
    )
    """Of `srbf_scattered`: lobes, with `max_error` or `max_bytes` the most of them; null is 162,
    and 642 with either."""
    max_iterations: Annotated[int, Field(ge=1, le=200)] | None = Field(
        default=None, validate_default=True
    )
    """Of `srbf_scattered`: rounds of refining them at most; null is 6."""
    n_centres: Literal[12, 42, 162, 642, 2562] | None = Field(default=None, validate_default=True)
    """Of `srbf_uniform`: points of the icosphere; null is 162."""
    bandwidth: Positive | None = None
    """Of `srbf_uniform`: of all functions; null is 60 for 642 centres, and in proportion."""
    sh_order: Annotated[int, Field(ge=1, le=MOST_ORDER)] | None = Field(
        default=None, validate_default=True
    )
    """Of `sh`: bands n, n² functions; null is 18."""
    resolution: Literal[8, 16, 32, 64, 128] | None = Field(default=None, validate_default=True)
    """Of `wavelet`: N of a cube map of 6 N² texels; null is 64."""
    n_wavelets: Annotated[int, Field(ge=1, le=6 * 128**2)] | None = Field(
        default=None, validate_default=True
    )
    """Of `wavelet`: those kept, the ones that hold most; null is 324."""

    @field_validator(*LIGHT_OWNERS)
    @classmethod
    def _of_its_method(cls, value: float | None, info: ValidationInfo) -> float | None:
        """Refuse what belongs to another method; settle the sizes of the one that is taken."""
        name, method = str(info.field_name), info.data.get("method")
        if method is None:  # refused itself
            return value
        if method != LIGHT_OWNERS[name]:
            if value is not None:
                raise ValueError(f"{name} is of method {LIGHT_OWNERS[name]!r}, not of {method!r}")
            return None
        if name == "n_wavelets" and info.data.get("resolution"):
            most = 6 * info.data["resolution"] ** 2
            if value is not None and value > most:
                raise ValueError(f"n_wavelets is {value:g}: the cube map has {most}")
        if name == "bandwidth" and value is not None and info.data.get("n_centres"):
            most = MOST_BANDWIDTH * info.data["n_centres"]
            if value > most:
                raise ValueError(f"bandwidth is {value:g}: at most {most:g} for so few functions")
        if value is not None:
            return value
        budgets = (info.data.get("max_error"), info.data.get("max_bytes"))
        if name == "n_lobes" and budgets != (None, None):
            return LOBES_TO_TARGET
        return LIGHT_SIZES.get(name)
