"""The chain of pictures from the brute-force reference to the delivered asset.

reference -> K terms -> BRDF tables -> vertex interpolation -> visibility sampling -> basis
-> 16-bit transfer -> light fit -> compression -> rounded factors

With bounces, the pictures up to the basis all hold the same indirect light, pass by pass, of
the path tracer; it cancels in their differences.  The stored transfer holds the bounces of the
bake, so what those lack falls into its line.  So does all that differs where a part scatters light
inside: there the pictures up to the basis are the path tracer's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.relight import project_light
from prtbake_workers.arrays import B8, F32, F64, Bool, Float32, Float64
from prtbake_workers.environment.sampling import EnvironmentSampler
from prtbake_workers.environment.subdivision import subdivided_texels
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.validation.budget import Budget, ChainPicture, make_budget
from prtbake_workers.validation.exact_terms import ExactTerms
from prtbake_workers.validation.hits import PixelHits, trace_camera
from prtbake_workers.validation.indirect import PathLight
from prtbake_workers.validation.light import cell_flux, draw_pass
from prtbake_workers.validation.monte_carlo import pixel_pictures, vertex_terms
from prtbake_workers.validation.sampled import (
    asset_picture,
    sampled_terms,
    term_picture,
)
from prtbake_workers.validation.scene import ValidationScene
from prtbake_workers.validation.shading import with_plain_terms

MERGED_LINE = "compression and rounded factors"
"""Where the asset before its quantisation is not at hand."""

BASIS_LINES = {"srbf": "SRBF basis", "sh": "SH basis"}
"""By the kind of the basis that transfer was projected on."""

STORED_LINE = "16-bit transfer"
BOUNCED_LINE = "bounces and 16-bit transfer"
"""In place of `STORED_LINE` where transfer was baked with bounces."""
UNBOUNCED_LINE = "bounces left out and 16-bit transfer"
"""Where only the reference has bounces."""
SCATTERED = "scattering"
UNSCATTERED = "scattering left out"
PARTLY_SCATTERED = "scattering left out of some parts"
"""What stands before that where parts have a medium."""

MEANINGS = {
    "reference": "brute force: importance sampling, shadow rays, the true BRDF, paths for bounces "
    "and media",
    "K terms": "the BRDF cut to a sum of K products",
    "BRDF tables": "the products' factors read from tables and a texture",
    "vertex interpolation": "light gathered at vertices, colours interpolated between them",
    "visibility sampling": "visibility known in the bake's own directions only",
    BASIS_LINES["srbf"]: "transport projected on spherical radial basis functions",
    BASIS_LINES["sh"]: "transport projected on spherical harmonics",
    STORED_LINE: "coefficients as the transfer file holds them",
    BOUNCED_LINE: "bounces as the bake gathered them, cut where it stopped, in place of the "
    "reference's, and coefficients as the transfer file holds them",
    UNBOUNCED_LINE: "no bounces, as the bake left them out, and coefficients as the transfer file "
    "holds them",
    "light fit": "the fitted light in place of the environment",
    "compression": "clusters and ranks in place of every vertex's own coefficients",
    "rounded factors": "factors as the asset file holds them",
    MERGED_LINE: "clusters, ranks and rounding, as the asset file holds them",
}
"""What each picture of the chain adds over the one before it."""

_IN_PLACE = (BOUNCED_LINE, UNBOUNCED_LINE, MERGED_LINE, BASIS_LINES["sh"])
"""What stands in place of others."""

LINES = tuple(name for name in MEANINGS if name not in _IN_PLACE)

_INSIDE = {
    SCATTERED: "light scattered inside by the bake's operator, between vertices and from its own "
    "directions and basis, in place of the reference's",
    UNSCATTERED: "light that leaves a medium where it fell, as the bake left its scattering out",
    PARTLY_SCATTERED: "light scattered inside by the bake's operator, between vertices and from "
    "its own directions and basis, or left where it fell on parts that the bake chose",
}


def with_scattering(inside: str, stored: str) -> str:
    """Name the line of the stored transfer where parts have a medium."""
    return f"{inside}{' and' if stored == STORED_LINE else ','} {stored}"


MEANINGS |= {
    with_scattering(inside, name): f"{what}; {MEANINGS[name]}"
    for inside, what in _INSIDE.items()
    for name in (STORED_LINE, BOUNCED_LINE, UNBOUNCED_LINE)
}
MERGED_LINES = (*LINES[:-2], MERGED_LINE)

N_WITH_PATHS = LINES.index(STORED_LINE)
"""Pictures that hold the path tracer's indirect light."""


@dataclass(frozen=True)
class ValidatedView:
    """One camera under one rotation of the light."""

    budget: Budget
    chain: tuple[ChainPicture, ...]
    reference: Float32[F32, "height width 3"]
    delivered: Float32[F32, "height width 3"]
    coverage: Bool[B8, "height width"]
    n_hits: int


def validate_camera(
    validation: ValidationScene,
    camera: Camera,
    rotations: list[Float64[F64, "3 3"]],
    settings: ValidateSettings,
    *,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> list[ValidatedView]:
    """Render the chain of one camera, once for every rotation of the light.

    Memory: at most about 0.3 GB of samples, whatever the number of terms (see
    `prtbake_workers.transport.reference.blocks`); the assets and the light of their vertices; and
    for each visible vertex, term and rotation 100 bytes.
    """
    hits = trace_camera(validation, camera, settings.width, settings.height)
    n_bounces = settings.reference_bounces(baked=validation.baked_bounces)
    paths = PathLight(validation, hits, n_bounces)
    light_passes = settings.passes * (1 + paths.n_traces)
    steps = len(rotations) * (light_passes + 1) + len(validation.parts)
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done / steps)

    chains = uncompressed_chains(
        validation, hits, paths, rotations, settings, seed=seed, advance=advance
    )
    names = (MERGED_LINE,) if validation.exact is None else LINES[-2:]
    assets = [own for own in (validation.exact, validation.delivered) if own is not None]
    views = []
    for rotation, uncompressed in zip(rotations, chains, strict=True):
        fitted = fitted_light(validation, rotation)
        chain = uncompressed + tuple(
            ChainPicture(name, asset_picture(asset, fitted, hits)[None])
            for name, asset in zip(names, assets, strict=True)
        )
        advance()
        views.append(
            ValidatedView(
                budget=make_budget(chain),
                chain=chain,
                reference=hits.picture(chain[0].mean),
                delivered=hits.picture(chain[-1].mean),
                coverage=hits.coverage,
                n_hits=len(hits.pixels),
            )
        )
    return views


def uncompressed_chains(
    validation: ValidationScene,
    hits: PixelHits,
    paths: PathLight,
    rotations: list[Float64[F64, "3 3"]],
    settings: ValidateSettings,
    *,
    seed: int,
    advance: Callable[[], None],
) -> list[tuple[ChainPicture, ...]]:
    """Render the chain from the reference to the fitted light, once for every rotation.

    Of the assets no factor is read, only surfaces; ``paths`` are of the same hits, and ``advance``
    is called after every pass and part.
    """
    exact = [ExactTerms(part.factorisation) for part in validation.parts]
    sampled = _sampled_pictures(validation, hits, rotations, advance)
    n_bounces = settings.reference_bounces(baked=validation.baked_bounces)
    names = line_names(validation, n_bounces)[: N_WITH_PATHS + 2]
    chains = []
    for index, rotation in enumerate(rotations):
        pictures = _monte_carlo_pictures(
            validation, hits, rotation, exact, settings, seed + index, advance
        )
        pictures += sampled[index]
        if paths.n_traces:
            direct = pictures[:N_WITH_PATHS]
            pictures[:N_WITH_PATHS] = paths.add(direct, rotation, settings, seed + index, advance)
        chains.append(tuple(ChainPicture(*one) for one in zip(names, pictures, strict=True)))
    return chains


def line_names(validation: ValidationScene, n_bounces: int) -> tuple[str, ...]:
    """Name the pictures of a chain whose reference has ``n_bounces``."""
    stored = STORED_LINE
    if validation.baked_bounces:
        stored = BOUNCED_LINE
    elif n_bounces:
        stored = UNBOUNCED_LINE
    scattered = {part.scattered for part in validation.parts if part.medium is not None}
    if scattered:
        inside = PARTLY_SCATTERED
        if len(scattered) == 1:
            inside = SCATTERED if scattered == {True} else UNSCATTERED
        stored = with_scattering(inside, stored)
    names = MERGED_LINES if validation.exact is None else LINES
    own = {STORED_LINE: stored, BASIS_LINES["srbf"]: BASIS_LINES[validation.basis.stored.kind]}
    return tuple(own.get(name, name) for name in names)


def _monte_carlo_pictures(
    validation: ValidationScene,
    hits: PixelHits,
    rotation: Float64[F64, "3 3"],
    exact: list[ExactTerms],
    settings: ValidateSettings,
    seed: int,
    advance: Callable[[], None],
) -> list[Float64[F64, "passes hits 3"]]:
    """Render reference, K terms, tables and vertices, with the same samples in the same pass."""
    sampler = EnvironmentSampler(validation.environment)
    rng = np.random.default_rng(seed)
    epsilon = ray_epsilon(validation.scene.bounds)
    plain = with_plain_terms(validation)
    passes = np.zeros((4, settings.passes, len(hits.pixels), 3))
    for index in range(settings.passes):
        light = draw_pass(sampler, rotation, settings.samples, rng)
        passes[:3, index] = pixel_pictures(validation, hits, light, exact, epsilon)
        terms = [
            vertex_terms(validation, part, hits.vertices_of(*span), light, epsilon)
            for part, span in zip(validation.parts, validation.scene.part_ranges, strict=True)
        ]
        passes[3, index] = term_picture(validation, plain, hits, terms)
        advance()
    return list(passes)


def _sampled_pictures(
    validation: ValidationScene,
    hits: PixelHits,
    rotations: list[Float64[F64, "3 3"]],
    advance: Callable[[], None],
) -> list[list[Float64[F64, "one hits 3"]]]:
    """Render from sampled visibility to the light fit, with one pass over rays and file."""
    basis, directions = validation.basis, validation.directions
    projection = basis.projection(directions.directions, directions.weights).matrix
    texels, solid_angles, radiance = subdivided_texels(validation.environment, basis.spacing_rad)
    lights = [
        basis.light_from_radiance(texels @ rotation.T, solid_angles, radiance)
        for rotation in rotations
    ]
    fluxes = [cell_flux(validation.environment, rotation, directions) for rotation in rotations]
    columns = np.concatenate(fluxes + [projection @ light for light in lights], axis=1)
    fitted = [fitted_light(validation, rotation) for rotation in rotations]
    on_stored = np.concatenate(lights + fitted, axis=1)
    gathered, stored = [], []
    for part, span in enumerate(validation.scene.part_ranges):
        vertices = hits.vertices_of(*span)
        gathered.append(sampled_terms(validation, part, vertices, columns))
        stored.append(validation.relight_stored(part, vertices, on_stored))
        advance()
    plain, n = with_plain_terms(validation), len(rotations)
    return [
        [
            term_picture(validation, plain, hits, [t[..., _rgb(column)] for t in terms])[None]
            for terms, column in (
                (gathered, index),
                (gathered, n + index),
                (stored, index),
                (stored, n + index),
            )
        ]
        for index in range(n)
    ]


def _rgb(index: int) -> slice:
    return slice(3 * index, 3 * index + 3)


def fitted_light(
    validation: ValidationScene, rotation: Float64[F64, "3 3"]
) -> Float64[F64, "coeffs 3"]:
    """Project the fitted light, turned."""
    return project_light(validation.basis.stored, validation.light, rotation)
