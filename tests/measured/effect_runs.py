"""Bake a scene as planning decides, then with every effect the other way, and compare.

The tasks are those of a ``bake`` job, one after the other in this process: what is counted is their
CPU time, without what starting a worker's child costs.  Errors are squared-error ratios in radiance
norm, area-weighted, of the part that loses most.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
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
from prtbake_storage.queue.stages import Results, Stage
from prtbake_workers.jobs.registry import REGISTRY
from support.local_stages import run_stage

LAST = "join"
VERTICES_AT_ONCE = 4096

TOLERANCES = {
    "view_dependence": "term_energy_lost",
    "subsurface_scattering": "subsurface_tolerance",
}
"""Settings that effects are held against where it is not ``bounce_tolerance``."""

Switches = Mapping[str, str]


@dataclass(frozen=True)
class Run:
    """A finished bake: CPU seconds of its tasks, where its transfer lies, and what was decided."""

    seconds: float
    transfer: Path
    decisions: Mapping[str, Mapping[str, Any]]
    n_vertices: int


class Bakes:
    """Bakes of one scene, its mesh registered once."""

    def __init__(
        self, scene: EffectScene, store: BlobStore, data: Path, settings: BakeSettings
    ) -> None:
        self.store = store
        fields, self.context = scene.registered(store, data)
        self.request = {
            "kind": "bake",
            "mesh": "mesh-0000000000000000",
            "settings": settings.model_dump(mode="json"),
            **fields,
        }

    def run(self, switches: Switches) -> Run:
        """Bake with switches thrown."""
        planned = self._planned(switches)
        return self._finished(*planned)

    def run_otherwise(self, effect: str, decided: Run) -> Run | None:
        """Bake with an effect forced the other way; None where it is decided alike all the same."""
        taken = decided.decisions[effect]["taken"]
        stages, results = self._planned({effect: "off" if taken else "on"})
        if _decisions(results)[effect]["taken"] == taken:
            return None
        return self._finished(stages, results)

    def _planned(self, switches: Switches) -> tuple[list[Stage], Results]:
        request = self.request | {"effects": dict(switches)}
        stages = REGISTRY.stages("bake", request, self.context)
        names = [stage.name for stage in stages]
        results = Results()
        run_stage(stages[0], results, self.store, time.process_time)
        return stages[1 : names.index(LAST) + 1], results

    def _finished(self, stages: Sequence[Stage], results: Results) -> Run:
        for stage in stages:
            run_stage(stage, results, self.store, time.process_time)
        return Run(
            seconds=sum(cost.seconds for name in results for cost in results.measured(name)),
            transfer=self.store.local_path(results[LAST][0]["transfer"]),
            decisions=_decisions(results),
            n_vertices=results["plan"][0]["plan"]["parts"][-1]["vertex_range"][1],
        )


def _decisions(results: Results) -> dict[str, dict[str, Any]]:
    """Give the decisions of a plan by their effects."""
    return {one["effect"]: one for one in results["plan"][0]["plan"]["effects"]}


@contextmanager
def two_open(first: Path, second: Path) -> Iterator[tuple[TransferFile, TransferFile]]:
    """Open two transfer files."""
    with open_transfer(first) as one, open_transfer(second) as other:
        yield one, other


def squared_error(of: Path, reference: Path) -> float:
    """Compare two transfers of one scene, in the part where they differ most.

    ``sum_v area |T - R|^2 / sum_v area |R|^2`` over whitened coefficients; terms are orthonormal,
    and one that a transfer lacks is zero there.  One channel stands for three where only one of
    the two has three.  The albedo that is kept beside transfer counts: on a black surface nothing
    differs.  1 where the reference is black and the other is not.
    """
    if of == reference:
        return 0.0
    most = 0.0
    with two_open(of, reference) as (ours, theirs):
        for index, (own, other) in enumerate(
            zip(ours.header.parts, theirs.header.parts, strict=True)
        ):
            difference = norm = 0.0
            for start in range(0, own.n_vertices, VERTICES_AT_ONCE):
                areas = own.areas[start : start + VERTICES_AT_ONCE]
                stop = start + len(areas)
                a = _rows(ours.read(index, start, stop), own.n_channels, own.albedo)
                b = _rows(theirs.read(index, start, stop), other.n_channels, other.albedo)
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
        decided = bakes.run({})
        switches = [name for name in Effects.model_fields if name in decided.decisions]
        whole, nothing = (bakes.run(dict.fromkeys(switches, way)) for way in ("on", "off"))
        everything = Row(
            scene=scene.name,
            effect=EVERYTHING,
            vertices=decided.n_vertices,
            seconds_decided=decided.seconds,
            seconds_on=whole.seconds,
            seconds_off=nothing.seconds,
            error_decided=squared_error(decided.transfer, whole.transfer),
            error_off=squared_error(nothing.transfer, whole.transfer),
        )
        rows = [everything]
        for name in switches:
            tolerance = getattr(settings, TOLERANCES.get(name, "bounce_tolerance"))
            row = _undisputed(everything, name, decided, tolerance)
            other = bakes.run_otherwise(name, decided)
            if other is not None:
                pair = (decided, other) if row.decided == "taken" else (other, decided)
                row = _compared(row, *pair, whole)
            rows.append(row)
        return rows


def _undisputed(everything: Row, effect: str, decided: Run, tolerance: float | None) -> Row:
    """Enter what is known of an effect without the bake that has it the other way."""
    decision = decided.decisions[effect]
    return Row(
        scene=everything.scene,
        effect=effect,
        vertices=everything.vertices,
        decided="taken" if decision["taken"] else "left",
        predicted=decision["predicted_error_otherwise"],
        tolerance=tolerance,
        seconds_decided=everything.seconds_decided,
        error_decided=everything.error_decided,
    )


def _compared(row: Row, on: Run, off: Run, whole: Run) -> Row:
    """Enter the bakes with an effect and without it."""
    return replace(
        row,
        seconds_on=on.seconds,
        seconds_off=off.seconds,
        error_on=squared_error(on.transfer, whole.transfer),
        error_off=squared_error(off.transfer, whole.transfer),
        changes=squared_error(off.transfer, on.transfer),
    )
