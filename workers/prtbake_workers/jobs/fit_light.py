"""Job kind ``fit_light``: an environment as lobes, spherical harmonics or wavelets."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.decode.light import FittedLight, LightFit
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.light import write_light
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.deadline import Deadline, ends_by
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit import fit_environment, fit_to_error
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.light_error import power_ratio
from prtbake_workers.environment.sh_projection import project_sh, sh_samples
from prtbake_workers.environment.uniform_srbf import fit_uniform_srbf, uniform_samples
from prtbake_workers.environment.wavelet_projection import project_wavelet, wavelet_samples
from prtbake_workers.jobs.inputs import versions
from prtbake_workers.jobs.lights import (
    LightSource,
    load_light,
    load_lights,
    share_notes,
)
from prtbake_workers.jobs.pointing import pointing_at

_MODULE = "prtbake_workers.jobs.fit_light"

FIT_SHARE = 0.95
"""Of the seconds asked for, for the fit; the file takes the rest."""

START_SECONDS = 0.9
"""Of a task's process."""

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Fit:
    """A light, the numbers it is made of, and what there is to tell of it."""

    light: FittedLight
    numbers: int
    power_ratio: float
    account: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def stages(
    environment: LightSource,
    settings: FitLightSettings,
    seed: int,
    *,
    settings_at: str = "/settings/fit_light",
    started: float | None = None,
) -> list[Stage]:
    """Fit in one task.

    ``settings_at`` is the JSON pointer to the settings in the request, ``started`` the job's start
    in seconds since 1970: what `max_seconds` cuts belongs to this job.
    """
    own = None if settings.max_seconds is None else started
    # without the fields of other methods, whatever those will be
    dumped = settings.model_dump(mode="json", exclude_none=True)
    args = {"environment": environment, "settings": dumped, "seed": seed}

    def fit(_: Results) -> list[Task]:
        return [Task(f"{_MODULE}:fit", args, label="fit", settings_at=settings_at, job_started=own)]

    return [Stage("fit_light", "fit", 10.0, fit)]


@pointing_at(FitLightSettings)
def fit(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: write ``light.h5``."""
    settings = FitLightSettings.model_validate(args["settings"])
    seconds, asked = settings.max_seconds, settings.max_bytes
    deadline = None if seconds is None else Deadline(FIT_SHARE * (seconds - START_SECONDS))
    source: LightSource = args["environment"]
    environment = load_light(context.store, source)
    shares = [] if isinstance(source, str) else share_notes(load_lights(context.store, source))
    path = context.scratch / "light.h5"
    provenance = {**args, "versions": versions()}
    if asked is not None:
        settings = _lobes_within(asked, settings, provenance, path)
    while True:
        with ends_by(deadline):
            found = fitted(
                environment,
                settings,
                args["seed"],
                lambda fraction, phase: context.progress(fraction, 1.0, phase),
            )
        write_light(path, replace(found.light, provenance=provenance))
        size = path.stat().st_size
        if asked is None or size <= asked:
            break
        # random numbers pack no better than these: unless zlib says otherwise, never reached
        settings = settings.model_copy(update={"n_lobes": (settings.n_lobes or 1) - 1})
    return {
        "light": context.store.put_file(path, move=True),
        "bytes": size,
        "light_method": found.light.method,
        "light_numbers": found.numbers,
        "power_ratio": found.power_ratio,
        "errors": {"light": float(found.light.error)},
        "notes": [*found.notes, *shares, *_of_budgets(args["settings"], size, deadline)],
        **found.account,
    }


def _lobes_within(
    asked: int, settings: FitLightSettings, provenance: dict[str, Any], path: Path
) -> FitLightSettings:
    """Take as many lobes as a file of so many bytes holds whatever their numbers are.

    Raises
    ------
    SettingsError
        Not one lobe fits; tells the least.
    """
    rng = np.random.default_rng(0)

    def size(lobes: int) -> int:
        """Write as many lobes of noise, which packs worst."""
        noise = LightFit(
            centres=rng.standard_normal((lobes, 3)),
            bandwidths=rng.random(lobes),
            coefficients=rng.standard_normal((lobes, 3)),
            error=0.0,
            provenance=provenance,
        )
        write_light(path, noise)
        return path.stat().st_size

    fits, most = 0, (settings.n_lobes or 1) + 1
    while most - fits > 1:
        middle = (fits + most) // 2
        fits, most = (middle, most) if size(middle) <= asked else (fits, middle)
    if fits == 0:
        raise SettingsError(
            f"max_bytes is {asked}: a light of one lobe takes {size(1)}",
            pointer="/settings/max_bytes",
        )
    return settings.model_copy(update={"n_lobes": fits})


def _of_budgets(settings: dict[str, Any], size: int, deadline: Deadline | None) -> list[str]:
    """Say what bytes and seconds that were asked for did."""
    notes = []
    if "max_bytes" in settings:
        notes.append(f"light.h5 takes {size} of {settings['max_bytes']} bytes")
    if deadline is not None and deadline.hit:
        notes.append(
            f"max_seconds {settings['max_seconds']:g} ended the light's refinement after "
            f"{deadline.spent:.1f} s"
        )
    return notes


def fitted(
    environment: Environment, settings: FitLightSettings, seed: int, progress: Progress
) -> Fit:
    """Fit an environment by the method of the settings."""
    match settings.method:
        case "srbf_scattered":
            return _scattered(environment, settings, seed, progress)
        case "srbf_uniform":
            n_centres = settings.n_centres or 0
            texels = uniform_samples(environment, n_centres, settings.bandwidth)
            lobes = fit_uniform_srbf(texels, n_centres, settings.bandwidth)
            return _of_functions(lobes, texels, _account_of_lobes(lobes), progress)
        case "sh":
            texels = sh_samples(environment, settings.sh_order or 0)
            harmonics = project_sh(texels, settings.sh_order or 0)
            return _of_functions(harmonics, texels, {}, progress)
        case "wavelet":
            resolution = settings.resolution or 0
            texels = wavelet_samples(environment, resolution)
            wavelets = project_wavelet(texels, resolution, settings.n_wavelets or 0)
            return _of_functions(wavelets, texels, {}, progress)


def _of_functions(
    light: FittedLight, texels: Cells, account: dict[str, Any], progress: Progress
) -> Fit:
    progress(1.0, "coefficients")
    return Fit(light, light.coefficients.size, power_ratio(light, texels), account)


def _scattered(
    environment: Environment, settings: FitLightSettings, seed: int, progress: Progress
) -> Fit:
    n_lobes, max_iterations = settings.n_lobes or 0, settings.max_iterations or 0
    notes = []
    if settings.max_error is None:
        result = fit_environment(
            environment, n_lobes, seed=seed, max_iterations=max_iterations, progress=progress
        )
        notes = _notes(n_lobes, len(result.centres), environment)
    else:
        result = fit_to_error(
            environment,
            settings.max_error,
            most_lobes=n_lobes,
            seed=seed,
            max_iterations=max_iterations,
            progress=progress,
        )
        notes = [
            f"{len(result.centres)} lobes leave {result.error:.3g} of the light, asked for at most "
            f"{settings.max_error:g}"
        ]
    light = LightFit(
        centres=result.centres,
        bandwidths=result.bandwidths,
        coefficients=result.coefficients,
        error=float(result.error),
    )
    account = _account_of_lobes(light) | {"peak_lobes": int(result.n_peak_lobes)}
    return Fit(light, 6 * len(light.centres), float(result.power_ratio), account, notes)


def _account_of_lobes(light: LightFit) -> dict[str, Any]:
    negative = (light.coefficients < 0).any(axis=1)
    return {"lobes": len(light.centres), "negative_lobes": int(negative.sum())}


def _notes(asked: int, found: int, environment: Environment) -> list[str]:
    if found == asked:
        return []
    size = f"{environment.width} x {environment.height}"
    return [f"the light has {found} lobes, not {asked}: a map of {size} texels calls for no more"]
