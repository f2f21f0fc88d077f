"""Job kind ``fit_light``: an environment as scattered SRBFs."""

from typing import Any

from prtbake_storage.contract.settings import FitLightSettings
from prtbake_storage.decode.asset import LightFit
from prtbake_storage.hdf5.resources import write_light
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit import fit_environment
from prtbake_workers.jobs.inputs import load_environment, versions

_MODULE = "prtbake_workers.jobs.fit_light"


def stages(environment: str, settings: FitLightSettings, seed: int) -> list[Stage]:
    """Fit in one task."""
    args = {"environment": environment, "settings": settings.model_dump(mode="json"), "seed": seed}

    def fit(_: Results) -> list[Task]:
        return [Task(f"{_MODULE}:fit", args, label="fit")]

    return [Stage("fit_light", "fit", 10.0, fit)]


def fit(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: write ``light.h5``."""
    settings = FitLightSettings.model_validate(args["settings"])
    environment = load_environment(context.store, args["environment"])
    result = fit_environment(
        environment,
        settings.n_lobes,
        seed=args["seed"],
        max_iterations=settings.max_iterations,
        progress=lambda fraction, phase: context.progress(fraction, 1.0, phase),
    )
    light = LightFit(
        centres=result.centres,
        bandwidths=result.bandwidths,
        coefficients=result.coefficients,
        error=float(result.error),
        provenance={**args, "versions": versions()},
    )
    path = context.scratch / "light.h5"
    write_light(path, light)
    size = path.stat().st_size
    return {
        "light": context.store.put_file(path, move=True),
        "bytes": size,
        "lobes": len(result.centres),
        "negative_lobes": int((result.coefficients < 0).any(axis=1).sum()),
        "peak_lobes": int(result.n_peak_lobes),
        "power_ratio": float(result.power_ratio),
        "errors": {"light": float(result.error)},
        "notes": _notes(settings.n_lobes, len(result.centres), environment),
    }


def _notes(asked: int, found: int, environment: Environment) -> list[str]:
    if found == asked:
        return []
    size = f"{environment.width} x {environment.height}"
    return [f"the light has {found} lobes, not {asked}: a map of {size} texels calls for no more"]
