"""Stages whose work the counts do not know: what they take depends on what they find."""

from prtbake_storage.contract.settings import CompressSettings, FitLightSettings


def uncounted(
    compress: CompressSettings, fit_light: FitLightSettings | None = None
) -> dict[str, str]:
    """Name the stages whose predicted seconds are those of another job, and say of which.

    Jobs teach no rates by them, and estimates warn.
    """
    found = {}
    if compress.max_error is not None:
        found["compress"] = (
            "max_error tries sizes until the error fits: seconds, bytes and memory are those of "
            "one fit at the sizes it starts from"
        )
    elif compress.max_bytes is not None:
        found["compress"] = (
            "max_bytes fits sizes that are ample for the bytes: seconds, bytes and memory are "
            "those of the sizes it starts from"
        )
    elif compress.max_seconds is not None:
        found["compress"] = "max_seconds is predicted as if it ended no fit"
    elif compress.classification != "static":
        found["compress"] = (
            f"{compress.classification} classification takes up to 25 times the seconds of static, "
            "which are those predicted"
        )
    elif compress.coherence or compress.overdraw_budget is not None:
        found["compress"] = "the seconds of coherence and overdraw_budget are not predicted"
    if fit_light is not None and fit_light.max_error is not None:
        found["fit_light"] = "max_error is predicted as if it took all of n_lobes"
    return found
