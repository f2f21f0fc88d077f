"""Bake a scene as planning decides, then with every effect the other way, and compare.

The tasks are those of a ``bake`` job, one after the other in this process: what is counted is their
CPU time, without what starting a worker's child costs.  Errors are squared-error ratios in radiance
norm, area-weighted, of the part that loses most.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from measured.effect_scenes import EffectScene
from measured.effects_table import EVERYTHING, Row
from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import BakeSettings, Effects
from prtbake_storage.hdf5.transfer import TransferFile, open_transfer
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.registry import REGISTRY
from support.local_stages import registered, run_stage

LAST = "join"
VERTICES_AT_ONCE = 4096

TOLERANCES: dict[str, Callable[[BakeSettings], float | None]] = {
    "view_dependence": lambda bake: bake.term_energy_lost,
    "subsurface_scattering": lambda bake: bake.subsurface_tolerance,
}
"""Of effects that are not held against ``bounce_tolerance``."""

Switches = Mapping[str, str]


@dataclass(frozen=True)
class Run:
    """A finished bake: CPU seconds of its tasks, and where its transfer lies."""

    seconds: float
    transfer: Path
    plan: Mapping[str, Any]

    def taken(self, effect: str) -> bool:
        """Whether an effect was simulated."""
        return taken(self.plan, effect)


def taken(plan: Mapping[str, Any], effect: str) -> bool:
    """Whether a plan simulates an effect."""
    return any(one["taken"] for one in plan["effects"] if one["effect"] == effect)


class Bakes:
    """Bakes of one scene, its mesh registered once."""

    def __init__(
        self, scene: EffectScene, store: BlobStore, data: Path, settings: BakeSettings
    ) -> None:
        self.store = store
        self.request = {
            "kind": "bake",
            "mesh": "mesh-0000000000000000",
            "settings": settings.model_dump(mode="json"),
            **scene.request,
        }
        self.context = {
            "mesh": registered(store, "mesh", **scene.mesh(store, data)),
            "brdf": {"spec": scene.request["brdf"]},
            "albedo_texture": None,
            "artefacts": {},
        }
        if scene.texture is not None:
            digest = store.put_bytes(scene.texture(data))
            self.request["albedo_texture"] = self.context["albedo_texture"] = digest

    def run(
        self, switches: Switches, differs_in: Run | None = None, effect: str = ""
    ) -> Run | None:
        """Bake with switches thrown; None where an effect is decided as before all the same."""
        request = self.request | {"effects": dict(switches)}
        stages = REGISTRY.stages("bake", request, self.context)
        names = [stage.name for stage in stages]
        results = Results()
        for stage in stages[: names.index(LAST) + 1]:
            run_stage(stage, results, self.store, time.process_time)
            plan = results["plan"][0]["plan"]
            if differs_in is not None and taken(plan, effect) == differs_in.taken(effect):
                return None
        return Run(
            seconds=sum(cost.seconds for name in results for cost in results.measured(name)),
            transfer=self.store.local_path(results[LAST][0]["transfer"]),
            plan=results["plan"][0]["plan"],
        )

    def surely(self, switches: Switches) -> Run:
        """Bake with switches thrown."""
        found = self.run(switches)
        assert found is not None
        return found


@contextmanager
def two_open(first: Path, second: Path) -> Iterator[tuple[TransferFile, TransferFile]]:
    """Open two transfer files."""
    with open_transfer(first) as one, open_transfer(second) as other:
        yield one, other


def squared_error(of: Path, reference: Path) -> float:
    """Compare two transfers of one scene, in the part where they differ most.

    ``sum_v area |T - R|^2 / sum_v area |R|^2`` over whitened coefficients; terms are orthonormal,
    and one that a transfer lacks is zero there.  One channel stands for three where only one of
    the two has three.  The albedo that is kept beside transfer counts where the two differ in it,
    as where a medium scatters or is taken as a surface.  1 where the reference is black and the
    other is not.
    """
    if of == reference:
        return 0.0
    most = 0.0
    with two_open(of, reference) as (ours, theirs):
        for index, (own, other) in enumerate(
            zip(ours.header.parts, theirs.header.parts, strict=True)
        ):
            difference = norm = 0.0
            tint = [np.ones(1), np.ones(1)]
            if not np.array_equal(own.albedo, other.albedo):
                tint = [own.albedo, other.albedo]
            for start in range(0, own.n_vertices, VERTICES_AT_ONCE):
                areas = own.areas[start : start + VERTICES_AT_ONCE]
                stop = start + len(areas)
                a = _rows(ours.read(index, start, stop), own.n_channels, tint[0])
                b = _rows(theirs.read(index, start, stop), other.n_channels, tint[1])
                terms = max(a.shape[2], b.shape[2])
                a, b = (_padded(rows, terms) for rows in (a, b))
                # broadcasting repeats one channel beside three
                gap = np.square(a - b).sum(axis=(2, 3), dtype=np.float64).mean(axis=1)
                difference += float(areas @ gap)
                size = np.square(b).sum(axis=(2, 3), dtype=np.float64).mean(axis=1)
                norm += float(areas @ size)
            most = max(most, difference / norm if norm else float(difference > 0.0))
    return most


def _rows(values: Any, n_channels: int, tint: Any) -> Any:
    """Shape (verts, channels, terms, coeffs)."""
    rows = values.reshape(len(values), n_channels, -1, values.shape[2])
    return rows * np.asarray(tint, np.float32)[:, None, None]


def _padded(rows: Any, terms: int) -> Any:
    return np.pad(rows, ((0, 0), (0, 0), (0, terms - rows.shape[2]), (0, 0)))


def measure(scene: EffectScene, data: Path, settings: BakeSettings) -> list[Row]:
    """Bake a scene in all ways that it can be, and return a row an effect and one for all."""
    with TemporaryDirectory(prefix="prtbake-effects-") as folder:
        bakes = Bakes(scene, open_store((Path(folder) / "blobs").as_uri()), data, settings)
        decided = bakes.surely({})
        switches = [name for name in Effects.model_fields if any_decision(decided.plan, name)]
        whole = bakes.surely(dict.fromkeys(switches, "on"))
        nothing = bakes.surely(dict.fromkeys(switches, "off"))
        n_vertices = decided.plan["parts"][-1]["vertex_range"][1]
        rows = [
            Row(
                scene=scene.name,
                effect=EVERYTHING,
                vertices=n_vertices,
                seconds_decided=decided.seconds,
                seconds_on=whole.seconds,
                seconds_off=nothing.seconds,
                error_decided=squared_error(decided.transfer, whole.transfer),
                error_off=squared_error(nothing.transfer, whole.transfer),
            )
        ]
        for name in switches:
            rows.append(_effect(scene.name, n_vertices, name, bakes, decided, whole, settings))
        return rows


def any_decision(plan: Mapping[str, Any], effect: str) -> dict[str, Any] | None:
    """Find the decision about an effect."""
    return next((one for one in plan["effects"] if one["effect"] == effect), None)


def _effect(
    scene: str,
    n_vertices: int,
    name: str,
    bakes: Bakes,
    decided: Run,
    whole: Run,
    settings: BakeSettings,
) -> Row:
    decision = any_decision(decided.plan, name)
    assert decision is not None
    row = Row(
        scene=scene,
        effect=name,
        vertices=n_vertices,
        decided="taken" if decision["taken"] else "left",
        predicted=decision["predicted_error_otherwise"],
        tolerance=TOLERANCES.get(name, lambda bake: bake.bounce_tolerance)(settings),
        seconds_decided=decided.seconds,
        error_decided=squared_error(decided.transfer, whole.transfer),
    )
    other = bakes.run({name: "off" if decision["taken"] else "on"}, decided, name)
    if other is None:
        return row
    on, off = (decided, other) if decision["taken"] else (other, decided)
    return row.with_runs(
        seconds=(on.seconds, off.seconds),
        errors=tuple(squared_error(one.transfer, whole.transfer) for one in (on, off)),
        changes=squared_error(off.transfer, on.transfer),
    )
