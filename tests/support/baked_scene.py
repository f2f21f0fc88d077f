"""A scene of several parts baked in memory, and its chain of pictures up to the uncompressed result.

The steps and functions are those of a bake job.  Transfer is kept as that job's tiles hold it, in 16
bits, one channel of direct light; bounces are linear in it and are made of what is lit, so that a
hundred thousand values a vertex need not bounce, nor be kept, to be lit once.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.sparse import coo_array

from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.light import LightFit
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.view_texture import fit_view_texture
from prtbake_workers.environment.fit import fit_environment
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.jobs.scene_file import make_basis, reflection_of
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.mirrored import product_of
from prtbake_workers.transport.quantise import quantise_transfer
from prtbake_workers.validation.budget import ChainPicture
from prtbake_workers.validation.chain import uncompressed_chains
from prtbake_workers.validation.hits import trace_camera
from prtbake_workers.validation.indirect import PathLight
from prtbake_workers.validation.scene import ValidationPart, ValidationScene
from support.bounce_scenes import opaque

TILE = 1024
"""Vertices baked at a time: their float32 coefficients are rounded and let go."""

SEED = 3


@dataclass(frozen=True, eq=False)
class BakedScene:
    """Scene, materials and basis, and the rounded direct transfer of every part, in tiles."""

    scene: Scene
    brdfs: list[Any]
    factorisations: list[Any]
    direct: list[list[Any]]
    basis: Any
    settings: Any
    lit: dict[Any, Any] = field(default_factory=dict)

    def lit_at(self, part, vertices, light, *, bounces=True):
        """What some vertices of a part gather, (verts, terms, columns); light is met once."""
        key = (light.tobytes(), bounces)
        if key not in self.lit:
            self.lit[key] = self.relight(light, bounces=bounces)
        return self.lit[key][part][vertices - self.scene.part_ranges[part][0]]

    def relight(self, light, *, bounces=True, rounds=None):
        """What every part's vertices gather of columns of whitened light, (verts, terms, columns).

        A job measures the rounds of means over neighbours on coefficients, not on this light.
        """
        lit = [
            np.concatenate([tile.dequantised() @ light for tile in tiles]).astype(np.float32)
            for tiles in self.direct
        ]
        if not bounces:
            return lit
        n_parts = len(self.brdfs)
        factorisations, albedo = reflection_of(
            self.scene, self.factorisations, [None] * n_parts, [None] * n_parts
        )
        found = bounce_block(
            opaque(self.scene), lit,
            factorisations=factorisations, albedo=albedo, n_channels=3,
            n_rays=[self.settings.bounce_rays] * n_parts, seed=SEED,
            max_bounces=self.settings.max_bounces, tolerance=self.settings.bounce_tolerance,
            rounds=rounds,
        )  # fmt: skip
        # column j has colour j mod 3, and meets the channel of that colour
        columns = np.arange(light.shape[1])
        return [
            one + added[:, columns % 3, :, columns].transpose(1, 2, 0)
            for one, added in zip(lit, found.added, strict=True)
        ]


def factorised(brdfs, settings):
    """Cut every BRDF to terms at `BakeSettings`."""
    return [
        factorise(brdf, n_terms=settings.n_terms, energy_lost=settings.term_energy_lost)
        for brdf in brdfs
    ]


def baked(meshes, brdfs, settings):
    """Bake direct light at `BakeSettings`."""
    scene = Scene.from_parts(meshes)
    factorisations = factorised(brdfs, settings)
    directions = cube_directions(settings.cube_resolution)
    basis = make_basis(settings.model_dump())
    projection = basis.projection(directions.directions, directions.weights)
    product = product_of(projection, directions.directions)
    accelerator = Accelerator(scene.positions, scene.faces)
    direct = [
        [
            quantise_transfer(
                bake_block(
                    scene, accelerator, (first, min(first + TILE, stop)),
                    factorisation=factorisation, projection=projection, directions=directions,
                    product=product, supersample=settings.supersample,
                ).coefficients
            )
            for first in range(start, stop, TILE)
        ]
        for (start, stop), factorisation in zip(scene.part_ranges, factorisations, strict=True)
    ]  # fmt: skip
    return BakedScene(scene, brdfs, factorisations, direct, basis, settings)


def validation_of_baked(own, environment, n_lobes, *, bounces=True):
    """Give a `BakedScene` or `BakedOnDemand` its references.

    All that the chain needs up to the fitted light; the asset has surfaces and no factors."""
    scene = own.scene
    accelerator = Accelerator(scene.positions, scene.faces, robust=True)
    textures = [
        None if one.is_constant_phi else fit_view_texture(one).values for one in own.factorisations
    ]

    def relight_stored(part, vertices, light):
        return own.lit_at(part, vertices, light, bounces=bounces).astype(np.float64)

    fit = fit_environment(environment, n_lobes, seed=SEED)
    return ValidationScene(
        scene=scene,
        accelerator=accelerator,
        parts=tuple(
            ValidationPart(brdf, factorisation, texture, accelerator)
            for brdf, factorisation, texture in zip(
                own.brdfs, own.factorisations, textures, strict=True
            )
        ),
        basis=own.basis,
        directions=cube_directions(own.settings.cube_resolution),
        supersample=own.settings.supersample,
        relight_stored=relight_stored,
        exact=None,
        delivered=_surfaces(scene, own.factorisations, textures, own.basis),
        environment=environment,
        light=LightFit(
            centres=fit.centres, bandwidths=fit.bandwidths, coefficients=fit.coefficients
        ),
        baked_bounces=bounces,
    )  # fmt: skip


def pixel_chain(validation, view, per_side, settings: ValidateSettings, *, n_points=None):
    """Render the chain at points of every pixel, and average them.

    What shows the scene of a pixel is found on ``per_side`` x ``per_side`` points; ``n_points`` of
    these, evenly taken, or all of them, are shaded.

    Returns pictures whose passes are (passes, height x width, 3): the means over pixels that Mitsuba
    shows, which many points approach.
    """
    size = settings.model_copy(
        update={"width": view.width * per_side, "height": view.height * per_side}
    )
    fine = trace_camera(validation, camera_of(view), size.width, size.height)
    pixels = pixel_of(fine.pixels, view, per_side)
    chosen, weights = evenly(pixels, n_points or per_side**2)
    hits = picked(fine, chosen, validation.scene.faces)
    paths = PathLight(validation, hits, size.reference_bounces(baked=validation.baked_bounces))
    (chain,) = uncompressed_chains(
        validation, hits, paths, [np.eye(3)], size, seed=SEED, advance=lambda: None
    )
    at = coo_array(
        (weights / per_side**2, (pixels[chosen], np.arange(len(chosen)))),
        shape=(view.height * view.width, len(chosen)),
    ).tocsr()
    return tuple(
        ChainPicture(one.name, np.stack([at @ each for each in one.passes])) for one in chain
    )


def pixel_of(points, view, per_side):
    """Tell the pixel of points that are numbered row by row of the finer picture."""
    row, column = np.divmod(points, view.width * per_side)
    return row // per_side * view.width + column // per_side


def evenly(pixels, n_points):
    """Choose at most so many of every pixel's points, and what each stands for."""
    order = np.argsort(pixels, kind="stable")
    _, starts, counts = np.unique(pixels[order], return_index=True, return_counts=True)
    kept = np.minimum(counts, n_points)
    rank = np.arange(kept.sum()) - np.repeat(np.cumsum(kept) - kept, kept)
    share = np.repeat(counts / kept, kept)
    chosen = order[np.repeat(starts, kept) + ((rank + 0.5) * share).astype(np.int64)]
    return chosen, share


def picked(hits, chosen, faces):
    """Keep some of the hits, and the vertices behind them."""
    return replace(
        hits, pixels=hits.pixels[chosen], triangles=hits.triangles[chosen],
        barycentrics=hits.barycentrics[chosen], parts=hits.parts[chosen],
        points=hits.points.block(chosen), frames=hits.frames[chosen], wo=hits.wo[chosen],
        vertices=np.unique(faces[hits.triangles[chosen]]).astype(np.int64),
    )  # fmt: skip


def camera_of(view):
    """The same view for our renderers, whose field of view is vertical."""
    half = np.tan(np.radians(0.5 * view.field_of_view_deg)) * view.height / view.width
    return Camera(
        eye=view.eye, target=view.target, fov_deg=float(2.0 * np.degrees(np.arctan(half)))
    )


def _surfaces(scene, factorisations, textures, basis):
    parts = []
    for index, (span, own) in enumerate(zip(scene.part_ranges, factorisations, strict=True)):
        n_vertices = span[1] - span[0]
        parts.append(
            Part(
                name=f"part{index}", vertex_range=span, material={}, albedo=own.albedo,
                n_channels=3, method="cta", labels=np.zeros(n_vertices, np.int32),
                weights=np.zeros((n_vertices, 0), np.float32), ranks=np.zeros((0, 3), np.int32),
                view_texture=textures[index],
                frames=scene.frames[slice(*span)].astype(np.float32),
            )
        )  # fmt: skip
    return Asset(
        positions=scene.positions.astype(np.float32), faces=scene.faces,
        normals=scene.normals.astype(np.float32), uv=None, parts=tuple(parts),
        basis=basis.stored,
    )  # fmt: skip
