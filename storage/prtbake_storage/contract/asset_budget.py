"""A budget of an asset: what it may err by, weigh and take."""

from prtbake_storage.contract.base import MaxBytes, MaxError
from prtbake_storage.contract.budget import Budget
from prtbake_storage.contract.settings import AssetSettings

DECIDED_BY_ERROR = (
    ("compress", "ranks"),
    ("compress", "n_components"),
    ("compress", "max_error"),
    ("compress", "max_bytes"),
    ("compress", "max_quantisation_error"),
    ("fit_light", "n_lobes"),
    ("fit_light", "max_error"),
    ("fit_light", "max_bytes"),
)
"""Settings that a budget's error takes the place of: stage and name."""

DECIDED_BY_BYTES = (
    ("compress", "ranks"),
    ("compress", "n_components"),
    ("compress", "max_bytes"),
    ("compress", "max_quantisation_error"),
)
"""Those that its bytes do."""

DECIDED_BY_EITHER = (
    ("compress", "max_seconds"),
    ("fit_light", "max_seconds"),
)
"""Those that either an error or a time does: a search counts on stages that end with what they were
asked for."""


class AssetBudget(Budget):
    """What an ``asset`` job may err by and take; one of them at least, and all that are given hold.

    For an error or a time planning searches the settings: it tunes at views of the light that are
    not those of the validation, and the report lists what it tried.  Bytes alone go with a quality.
    """

    max_error: MaxError | None = None
    """Relative L2 error of the pictures against the reference, as the error budget's total."""
    max_bytes: MaxBytes | None = None
    """Of `asset.h5` as it is written, mesh and tables included; the light is another file."""

    @property
    def searched(self) -> bool:
        """Whether the quality is: bytes alone are met at any."""
        return self.max_error is not None or self.max_seconds is not None

    def laid_over(self, settings: AssetSettings) -> AssetSettings:
        """Let bytes that stand alone decide the compression; a search holds attempts to them."""
        if self.max_bytes is None or self.searched:
            return settings
        compress = settings.compress | {"max_bytes": self.max_bytes}
        return settings.model_copy(update={"compress": compress})

    def check_beside(self, settings: AssetSettings) -> None:
        """Refuse settings that would decide what the budget decides.

        Raises
        ------
        ValueError
            Naming the first of them.
        """
        decided = [
            ("the budget", DECIDED_BY_EITHER, self.searched, ()),
            ("budget.max_error", DECIDED_BY_ERROR, self.max_error is not None, (8,)),
            ("budget.max_bytes", DECIDED_BY_BYTES, self.max_bytes is not None, (8, 16)),
        ]
        for who, names, asked, bits in decided:
            if not asked:
                continue
            for stage, name in names:
                if getattr(settings, stage).get(name) is not None:
                    raise ValueError(f"{who} chooses {stage}.{name}: give one of them")
            if settings.compress.get("bits") in bits:
                left = "'auto'" if 16 in bits else "'auto', or 16"
                raise ValueError(f"{who} chooses compress.bits: leave them {left}")
