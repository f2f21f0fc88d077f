"""The light of a job: an environment, or several that shine together."""

from collections.abc import Mapping, Sequence
from typing import Any

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_storage.hdf5.resources import read_environment
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.summing import AddedLight, sum_environments
from prtbake_workers.percent import percent

LightSource = str | list[dict[str, Any]]
"""Digest of an environment; of several, each one's ``digest``, ``scale`` and ``rotation_deg``."""


def light_source(context: Mapping[str, Any]) -> LightSource:
    """Name the light that a job's context holds, as tasks are given it.

    A job of one environment names it as it did before there were several: its tasks are the same.
    """
    own = context["environment"]["canonical"]
    if not context.get("lights"):
        return str(own)
    added = [
        {
            "digest": light["canonical"],
            "scale": light["scale"],
            "rotation_deg": light["rotation_deg"],
        }
        for light in context["lights"]
    ]
    return [{"digest": own, "scale": 1.0, "rotation_deg": [0.0, 0.0, 0.0]}, *added]


def load_light(store: BlobStore, source: LightSource) -> Environment:
    """Load the environment, or the sum of several."""
    if isinstance(source, str):
        return Environment(read_environment(store.local_path(source)).radiance)
    return sum_environments(load_lights(store, source))


def check_light(store: BlobStore, source: LightSource) -> None:
    """See that every environment can be read, without adding them up."""
    if isinstance(source, str):
        load_light(store, source)
    else:
        for light in source:
            load_light(store, light["digest"])


def load_lights(store: BlobStore, source: Sequence[Mapping[str, Any]]) -> list[AddedLight]:
    """Load several environments by themselves."""
    return [
        AddedLight(
            load_light(store, light["digest"]),
            float(light["scale"]),
            rotation_matrix(light["rotation_deg"]) if any(light["rotation_deg"]) else None,
        )
        for light in source
    ]


def share_notes(lights: Sequence[AddedLight]) -> list[str]:
    """Say what each of several lights gives of the power of all."""
    powers = [light.power for light in lights]
    whole = sum(powers)
    shares = ", ".join(percent(power / whole) if whole else "none" for power in powers)
    return [f"{len(powers)} environments shine together: of their power each gives {shares}"]
