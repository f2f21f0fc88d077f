"""Stages whose work goes by what they find: their counts are those of a mean scene."""

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import CompressSettings
from prtbake_workers.planning.expected_sizes import OFF_BY, VQ_OFF_BY


def uncounted(
    compress: CompressSettings, fit_light: FitLightSettings | None = None
) -> dict[str, str]:
    """Name the stages whose predictions a scene may be far from, and say how far.

    Estimates warn.
    """
    found = {}
    if compress.max_error is not None:
        off_by = VQ_OFF_BY if compress.method == "vq" else OFF_BY
        found["compress"] = (
            "max_error tries sizes until the error fits: those predicted are of a mean scene, and "
            f"may be {off_by:g} times too many or too few, and bytes and seconds with them"
        )
    elif compress.max_bytes is not None:
        found["compress"] = (
            "max_bytes fits sizes that are ample for the bytes: seconds, bytes and memory are "
            "those of the sizes it starts from"
        )
    elif compress.max_seconds is not None:
        found["compress"] = "max_seconds is predicted as if it ended no fit"
    if fit_light is not None:
        found |= _of_light(fit_light)
    return found


def _of_light(settings: FitLightSettings) -> dict[str, str]:
    for name in ("max_error", "max_bytes"):
        if getattr(settings, name) is not None:
            return {
                "fit_light": f"{name} takes as many lobes as it needs: seconds and bytes are those "
                f"of all {settings.n_lobes}, at most"
            }
    if settings.max_seconds is not None:
        return {"fit_light": "max_seconds is predicted as if it ended no fit"}
    return {}


def untaught(compress: CompressSettings, fit_light: FitLightSettings | None = None) -> set[str]:
    """Name the stages that teach no rates: a scene's own ways would be taken for the machine's."""
    found = set(uncounted(compress, fit_light))
    drawn = compress.coherence or compress.overdraw_budget is not None
    if drawn or compress.classification != "static":
        found.add("compress")
    return found
