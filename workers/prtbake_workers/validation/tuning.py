"""What an asset in the making errs by at views of its own: the measure that a budget is tuned by.

The reference of a view is rendered once, with as many light samples as an error that is aimed at
asks for, and kept with its variance; every attempt after that renders its own picture alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil

import numpy as np

from prtbake_storage.contract.settings import ValidateSettings
from prtbake_storage.decode.asset import Asset
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.sampling import EnvironmentSampler
from prtbake_workers.environment.subdivision import subdivided_texels
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.validation.budget import Budget, make_budget
from prtbake_workers.validation.chain import fitted_light, uncompressed_chains
from prtbake_workers.validation.exact_terms import ExactTerms
from prtbake_workers.validation.hits import PixelHits
from prtbake_workers.validation.indirect import PathLight
from prtbake_workers.validation.light import draw_pass
from prtbake_workers.validation.monte_carlo import pixel_pictures
from prtbake_workers.validation.sampled import asset_picture, term_picture
from prtbake_workers.validation.scene import ValidationScene
from prtbake_workers.validation.shading import with_plain_terms

MOST_TIMES = 64.0
"""Light samples of a reference over those of its settings, at most."""

FAR_OFF = 0.2
"""Of what an asset errs by, that noise may be where the aim is far below: that is seen without."""

SEED_OFFSET = 500_000
"""Of the reference's samples, to those of the chain that tells the lines."""


@dataclass(frozen=True)
class TunedReference:
    """A view's reference: its picture, what its noise adds to a squared difference, its norm."""

    mean: Float64[F64, "hits 3"]
    variance: float
    """Summed over the picture."""
    samples: int
    """Light samples of every pass."""

    @property
    def squared_norm(self) -> float:
        """Of the picture without its noise."""
        return max(float((self.mean**2).sum()) - self.variance, 0.0)

    def squared_difference(self, picture: Float64[F64, "hits 3"]) -> float:
        """Give the squared norm of a difference, the noise of the reference in it."""
        return float(((picture - self.mean) ** 2).sum())


def tuned_references(
    validation: ValidationScene,
    hits: PixelHits,
    rotations: list[Float64[F64, "3 3"]],
    settings: ValidateSettings,
    *,
    noise: float,
    seed: int,
) -> tuple[list[TunedReference], list[Budget]]:
    """Render the references of a camera, one a rotation, and the lines of the chain at first.

    Parameters
    ----------
    noise
        Relative standard error that a reference should have, or `FAR_OFF` of the chain's own total;
        it gets up to `MOST_TIMES` the samples of the settings for it.

    Returns
    -------
    list of TunedReference, list of Budget
        The budgets are of the chain from the reference to the fitted light, by the samples that the
        settings say.
    """
    n_bounces = settings.reference_bounces(baked=validation.baked_bounces)
    paths = PathLight(validation, hits, n_bounces)
    chains = uncompressed_chains(
        validation, hits, paths, rotations, settings, seed=seed, advance=_nothing
    )
    budgets = [make_budget(chain) for chain in chains]
    references = []
    for index, (rotation, budget) in enumerate(zip(rotations, budgets, strict=True)):
        enough = max(noise, FAR_OFF * budget.total)
        times = min(max((budget.reference_noise / enough) ** 2, 1.0), MOST_TIMES)
        more = settings.model_copy(
            update={
                "samples": min(ceil(settings.samples * times), 65536),
                "bounce_samples": min(ceil(settings.paths * times), 65536),
            }
        )
        references.append(
            _reference(validation, hits, paths, rotation, more, seed + SEED_OFFSET + index)
        )
    return references, budgets


def _nothing() -> None:
    """Tell nobody of a pass."""


def _reference(
    validation: ValidationScene,
    hits: PixelHits,
    paths: PathLight,
    rotation: Float64[F64, "3 3"],
    settings: ValidateSettings,
    seed: int,
) -> TunedReference:
    sampler, rng = EnvironmentSampler(validation.environment), np.random.default_rng(seed)
    exact = [ExactTerms(part.factorisation) for part in validation.parts]
    epsilon = ray_epsilon(validation.scene.bounds)
    passes = np.zeros((settings.passes, len(hits.pixels), 3))
    for index in range(settings.passes):
        light = draw_pass(sampler, rotation, settings.samples, rng)
        passes[index] = pixel_pictures(validation, hits, light, exact, epsilon)[0]
    if paths.n_traces:
        (passes,) = paths.add([passes], rotation, settings, seed, _nothing)
    variance = float(passes.var(axis=0, ddof=1).sum()) / len(passes)
    return TunedReference(passes.mean(axis=0), variance, settings.samples)


def attempted_pictures(
    validation: ValidationScene, hits: PixelHits, rotation: Float64[F64, "3 3"]
) -> Mapping[str, Float64[F64, "hits 3"]]:
    """Shade from the stored transfer, under the environment itself and under its fit."""
    basis = validation.basis
    texels, solid_angles, radiance = subdivided_texels(validation.environment, basis.spacing_rad)
    light = basis.light_from_radiance(texels @ rotation.T, solid_angles, radiance)
    columns = np.concatenate([light, fitted_light(validation, rotation)], axis=1)
    plain = with_plain_terms(validation)
    stored = [
        validation.relight_stored(part, hits.vertices_of(*span), columns)
        for part, span in enumerate(validation.scene.part_ranges)
    ]
    return {
        name: term_picture(
            validation, plain, hits, [terms[..., 3 * at : 3 * at + 3] for terms in stored]
        )
        for at, name in enumerate(("transfer", "light"))
    }


def compressed_picture(
    validation: ValidationScene, asset: Asset, hits: PixelHits, rotation: Float64[F64, "3 3"]
) -> Float64[F64, "hits 3"]:
    """Decode an asset under the fitted light."""
    return asset_picture(asset, fitted_light(validation, rotation), hits)
