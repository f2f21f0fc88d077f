"""Peak memory of the processes of the stages after the bake, by what they hold at once.

Each begins with what its imports take; the rest was measured on small scenes and follows from how
the stage cuts its work.
"""

from collections.abc import Sequence
from typing import Literal

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import MEDIUM_PATHS, RenderSettings, ValidateSettings
from prtbake_storage.decode.light import VALUES_AT_A_TIME
from prtbake_storage.decode.transfer_basis import LIGHT_CHUNK
from prtbake_workers.environment.fit.objective import SOLVED_AT_A_TIME
from prtbake_workers.planning.cost import CHILD_BYTES, GLOSSY_BYTES
from prtbake_workers.planning.light_pieces import (
    FitSamples,
    cut_texels,
    projected_pieces,
    spacing_of,
)
from prtbake_workers.planning.presets import PlannedBake
from prtbake_workers.planning.seen_pixels import SeenPixels
from prtbake_workers.transport.quantise import CHUNK_NUMBERS
from prtbake_workers.transport.reference import RAYS_PER_BLOCK, VALUES_PER_BLOCK

Lobe = Literal["none", "isotropic", "anisotropic"]
"""What a BRDF has beside its diffuse part."""

REPORT_BYTES = 161_000_000
FIT_BYTES = 124_000_000
RENDER_BYTES = 165_000_000
"""Of the interpreter with what each imports; of rendering with its drivers too, of a report with
what draws its figures."""

FIT_SAMPLE_BYTES, PIECE_BYTES = 112, 137
"""Of a sample of the light that lobes are fitted in, and of a piece that it is projected from."""

PIXEL_BYTES = 370
"""Of a preview, at four points a pixel."""

ROUNDED_VALUE_BYTES = 20
"""Of a coefficient of the vertices that are rounded at a time: its level in float32, in whose place
is then what rounding leaves, and that in float64, which is still held of those before them.  Levels
in 16 bits are those of the whole."""

REBUILT_BYTES, REBUILT_VERTS = 20, 2048
"""Of a coefficient that quantisation is measured by, at so many vertices at once."""

VALIDATE_BYTES, SEVERAL_TERMS_BYTES = 20_000_000, 38_000_000
"""Of scene, assets and tables of a validation that is about to begin, as measured on 60 jobs: of
parts with a term each, and of more, as the allocator keeps some of what found their exact terms."""

DIFFUSE_SAMPLE_BYTES, LOBE_SAMPLE_BYTES = 80, 150
"""Of a light sample at a pixel, as if each were lit.  The cosine and its product with the
reflection, the local direction, and that of what is lit, its place and its reflection; of a lobe
some eight numbers of the half vector in float64 besides."""

LIT_BYTES, LIT_TERM_BYTES = 72, 32
"""The same where terms are gathered: of a term, by table and exactly at once, what is evaluated,
laid out and multiplied by the cosine, each in float64.  How much is lit is not known: that all is
was chosen, as it comes nearest to jobs of 3 to 16 terms."""

CELL_BYTES: dict[Lobe, int] = {"none": 52, "isotropic": 52, "anisotropic": 0}
CELL_TERM_BYTES: dict[Lobe, int] = {"none": 20, "isotropic": 20, "anisotropic": 32}
"""Of a vertex in one of the bake's directions, of which half are lit, and of each term: laid out,
multiplied and evaluated.  Those of anisotropic parts are no count: they were chosen by three jobs
whose validation is led by cells, of 5, 9 and 13 terms."""

PATH_BYTES, INSIDE_PATH_BYTES = 600, 1150
"""Of a path, and of one that begins where light is scattered inside."""

LIGHT_VALUES, PROJECTION_VALUES = 4, 3
"""Float64 of a function of the basis in a direction: of light, at `LIGHT_CHUNK` directions at once,
as its arrays are counted, and in the bake's own directions, of which two are counted and the third
was chosen by what jobs with 6,144 of them hold."""

CHAIN_BYTES = 96
"""Of a pixel and pass: four pictures of three colours."""


def add_bounces_memory_bytes(
    verts: int, values: int, *, n_channels: int = 1, n_blocks: int = 1
) -> int:
    """Predict what laying bounces over a tile holds.

    Direct light and the sum in float32, with one of ``n_blocks`` in 16 bits and in float32, and
    later the whole in 16 bits with those values that are being rounded, see `ROUNDED_VALUE_BYTES`.

    Parameters
    ----------
    verts, values
        Of the tile: vertices, and coefficients of each, all channels.
    """
    whole = verts * values
    rounding = 2 * whole + ROUNDED_VALUE_BYTES * min(whole, max(values, CHUNK_NUMBERS))
    return CHILD_BYTES + 4 * whole // n_channels + 4 * whole + max(6 * whole // n_blocks, rounding)


def quantise_memory_bytes(parts: Sequence[tuple[int, int]]) -> int:
    """Predict what writing the asset holds; parts are (vertices, coefficients of one vertex)."""
    most = max(min(verts, REBUILT_VERTS) * values for verts, values in parts)
    return CHILD_BYTES + REBUILT_BYTES * most


def fit_memory_bytes(
    settings: FitLightSettings, *, n_texels: int, samples: FitSamples | None = None
) -> int:
    """Predict what a light fit holds: the map's samples, and lobes in many of them at once.

    No ``samples`` are those of a map without a bright texel.
    """
    if settings.method != "srbf_scattered":
        pieces = projected_pieces(settings, n_texels)
        functions = (settings.n_centres or 0) + (settings.sh_order or 0) ** 2
        arrays = 4 if settings.method == "srbf_uniform" else 1
        at_once = min(VALUES_AT_A_TIME, pieces * functions)
        return FIT_BYTES + PIECE_BYTES * pieces + 8 * arrays * at_once
    own = samples or FitSamples.unsplit(n_texels)
    lobes = min(settings.n_lobes or 0, own.moving)
    moving = 32 * min(96 * lobes + 4096, own.moving) * lobes
    solving = FIT_SAMPLE_BYTES * (own.moving + own.solving + own.judging)
    solving += 24 * min(SOLVED_AT_A_TIME, own.solving) * lobes
    return FIT_BYTES + max(moving, solving)


def render_memory_bytes(settings: RenderSettings) -> int:
    """Predict what previews hold."""
    return RENDER_BYTES + PIXEL_BYTES * settings.width * settings.height


def validate_memory_bytes(
    settings: ValidateSettings,
    *,
    seen: Sequence[SeenPixels],
    part_terms: Sequence[int],
    lobes: Sequence[Lobe],
    bake: PlannedBake,
    n_texels: int,
    baked_bounces: bool = False,
) -> int:
    """Predict what the chain of pictures of the largest camera holds.

    ``part_terms`` and ``lobes`` are those of each part.
    """
    paths = bool(settings.reference_bounces(baked=baked_bounces))
    n_dirs, n_coeffs = 6 * bake.cube_resolution**2, bake.n_coeffs
    at_once = min(LIGHT_CHUNK, cut_texels(n_texels, spacing_of(bake, n_coeffs)))
    # what the environment is on the basis, beside the projection and the roots of the Gram matrix
    light = 8 * n_coeffs * (LIGHT_VALUES * at_once + PROJECTION_VALUES * n_dirs + 2 * n_coeffs)
    held = VALIDATE_BYTES if max(part_terms) == 1 else SEVERAL_TERMS_BYTES
    found = GLOSSY_BYTES if any(lobe != "none" for lobe in lobes) else 0
    return CHILD_BYTES + max(
        found,
        held
        + max(
            max(
                light,
                _path_bytes(one.pixels - one.inside, settings.paths, PATH_BYTES) if paths else 0,
                _path_bytes(one.inside, MEDIUM_PATHS * settings.paths, INSIDE_PATH_BYTES),
                *(
                    _part_bytes(pixels, one.vertices, settings.samples, n_dirs, terms, lobe)
                    for pixels, terms, lobe in zip(one.parts, part_terms, lobes, strict=True)
                ),
            )
            + CHAIN_BYTES * one.pixels * settings.passes * len(settings.rotations_deg)
            for one in seen
        ),
    )


def _path_bytes(pixels: int, paths: int, bytes_each: int) -> int:
    """Of the paths of a block of pixels."""
    return bytes_each * min(RAYS_PER_BLOCK, pixels * paths)


def _part_bytes(
    pixels: int, vertices: int, samples: int, n_dirs: int, terms: int, lobe: Lobe
) -> int:
    """Of lighting a part's pixels by samples, or its vertices from all directions, in blocks."""
    most = min(RAYS_PER_BLOCK, VALUES_PER_BLOCK // terms)
    sample = DIFFUSE_SAMPLE_BYTES
    if lobe != "none":
        sample = max(LOBE_SAMPLE_BYTES, LIT_BYTES + LIT_TERM_BYTES * terms if terms > 1 else 0)
    return max(
        min(most, pixels * samples) * sample,
        min(most, vertices * n_dirs) * (CELL_BYTES[lobe] + CELL_TERM_BYTES[lobe] * terms),
    )
