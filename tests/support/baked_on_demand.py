"""The same bake of those vertices alone whose light is asked for, and of all that send them any.

A picture of a few hundred pixels shows a part of a finely cut scene; what this gives is what
`BakedScene` gives, in a part of the time and without its coefficients being kept.
"""

import time
from dataclasses import replace

import numpy as np

from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.ray_offset import offset_origins
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.jobs.scene_file import make_basis, reflection_of
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.hemisphere_rays import cosine_directions, lattice, shifted, shifts
from prtbake_workers.transport.mirrored import product_of
from prtbake_workers.transport.quantise import quantise_transfer
from prtbake_workers.transport.separable_bounce import BounceGather
from support.baked_scene import SEED, factorised
from support.bounce_scenes import opaque

TILE = 4096
"""Vertices baked, and those whose rays are kept, at a time."""


class BakedOnDemand:
    """A scene, its materials and basis, and what its vertices gather of one light.

    Every bounce up to ``settings.max_bounces`` is made, whatever it adds.  ``n_baked`` counts the
    vertices baked so far, ``seconds`` what they and their bounces took.
    """

    def __init__(self, meshes, brdfs, settings):
        self.scene = Scene.from_parts(meshes)
        self.brdfs, self.settings = brdfs, settings
        self.factorisations = factorised(brdfs, settings)
        self.basis = make_basis(settings.model_dump())
        self.n_baked, self.seconds = 0, 0.0
        self._directions = cube_directions(settings.cube_resolution)
        self._projection = self.basis.projection(
            self._directions.directions, self._directions.weights
        )
        self._product = product_of(self._projection, self._directions.directions)
        self._surface = opaque(self.scene)
        self._shadows = Accelerator(self.scene.positions, self.scene.faces)
        self._light, self._lit = None, []

    def lit_at(self, part, vertices, light, *, bounces=True):
        """What some vertices of a part gather of three columns a light, (verts, terms, columns)."""
        began = time.perf_counter()
        asked = self._senders(vertices, self.settings.max_bounces if bounces else 0)
        self._bake(asked[0], light)
        colours = [_by_colour(one) for one in self._lit]
        start = self.scene.part_ranges[part][0]
        total = colours[part][vertices - start]
        for arriving in asked[1:]:
            colours = self._bounced(arriving, colours)
            total = total + colours[part][vertices - start]
        self.seconds += time.perf_counter() - began
        # what was left out is not a number: none of it may have been met
        assert np.isfinite(total).all()
        return total.transpose(0, 2, 3, 1).reshape(len(vertices), -1, light.shape[1])

    def _senders(self, vertices, n_bounces):
        """Whose light of no bounce, of one and so on is asked for, the last being the vertices."""
        sets = [vertices]
        for _ in range(n_bounces):
            sets.append(np.union1d(sets[-1], self._met(sets[-1])))
        return sets[::-1]

    def _met(self, vertices):
        """Corners of all triangles that the bounce rays of vertices meet: `BounceGather`'s rays."""
        scene, n_rays = self.scene, self.settings.bounce_rays
        shift = shifts(SEED, 0, scene.n_vertices, 2)[scene.twins[vertices]]
        drawn = cosine_directions(shifted(lattice(n_rays), shift))
        world = (drawn @ tangent_frames(scene.normals[vertices])).astype(np.float32)
        origins = offset_origins(
            scene.ray_points[vertices], scene.ray_sides[vertices], self._surface.epsilon
        )
        hits = self._surface.intersect(
            np.repeat(origins, n_rays, axis=0), np.ascontiguousarray(world.reshape(-1, 3))
        )
        return np.unique(scene.faces[hits.triangles]).astype(np.int64)

    def _bake(self, vertices, light):
        """Bake, round and light those vertices that are not yet lit."""
        if self._light is None:
            self._light, self._lit = light, self._nothing((light.shape[1],))
        assert np.array_equal(light, self._light)
        for part, own in self._by_part(vertices):
            lit, start = self._lit[part], self.scene.part_ranges[part][0]
            missing = own[np.isnan(lit[own - start, 0, 0])]
            for first in range(0, len(missing), TILE):
                tile = missing[first : first + TILE]
                block = bake_block(
                    _alone(self.scene, tile), self._shadows, (0, len(tile)),
                    factorisation=self.factorisations[part], projection=self._projection,
                    directions=self._directions, product=self._product, supersample=self.settings.supersample,
                )  # fmt: skip
                lit[tile - start] = quantise_transfer(block.coefficients).dequantised() @ light
            self.n_baked += len(missing)

    def _bounced(self, vertices, colours):
        """One bounce of what all parts send, to some vertices."""
        n_parts = len(self.brdfs)
        factorisations, albedo = reflection_of(
            self.scene, self.factorisations, [None] * n_parts, [None] * n_parts
        )
        arrived = [np.full_like(one, np.nan) for one in colours]
        for part, own in self._by_part(vertices):
            start = self.scene.part_ranges[part][0]
            for first in range(0, len(own), TILE):
                tile = own[first : first + TILE]
                gather = BounceGather(
                    self._surface, part, tile, factorisations=factorisations, albedo=albedo,
                    n_channels=3, n_rays=self.settings.bounce_rays, seed=SEED,
                )  # fmt: skip
                arrived[part][tile - start] = gather.apply(colours)
        return arrived

    def _by_part(self, vertices):
        for part, (start, stop) in enumerate(self.scene.part_ranges):
            yield part, vertices[(vertices >= start) & (vertices < stop)]

    def _nothing(self, shape):
        return [
            np.full((stop - start, own.n_terms, *shape), np.nan, np.float32)
            for (start, stop), own in zip(self.scene.part_ranges, self.factorisations, strict=True)
        ]


def _by_colour(lit):
    """(verts, terms, 3 columns a light) as (verts, colours, terms, lights): no two colours mix."""
    n_verts, n_terms, n_columns = lit.shape
    return np.ascontiguousarray(
        lit.reshape(n_verts, n_terms, n_columns // 3, 3).transpose(0, 3, 1, 2)
    )


def _alone(scene, vertices):
    """Some vertices as a scene; where their rays start is as it was among all."""
    alone = replace(
        scene, positions=scene.positions[vertices], normals=scene.normals[vertices],
        faces=np.zeros((0, 3), np.int32), part_of_face=np.zeros(0, np.int32),
        frames=scene.frames[vertices], areas=scene.areas[vertices], uv=None,
        part_ranges=((0, len(vertices)),), bodies=None,
    )  # fmt: skip
    # in place of what would be found of these alone
    alone.__dict__.update(
        bounds=scene.bounds, ray_points=scene.ray_points[vertices],
        ray_sides=scene.ray_sides[vertices],
    )  # fmt: skip
    return alone
