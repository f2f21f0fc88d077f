"""Real spherical harmonics: evaluation, rotation, light, and projection on the hemisphere."""

from prtbake_storage.decode.sh import eval_sh
from prtbake_workers.basis.glossy_matrix import glossy_matrix
from prtbake_workers.basis.hemisphere import hemisphere_gram, hemisphere_projection_error
from prtbake_workers.basis.hemisphere_basis import HemisphereBasis
from prtbake_workers.basis.sh_light import sh_light
from prtbake_workers.basis.sh_rotation import rotate_sh, sh_rotation_matrix

__all__ = [
    "HemisphereBasis",
    "eval_sh",
    "glossy_matrix",
    "hemisphere_gram",
    "hemisphere_projection_error",
    "rotate_sh",
    "sh_light",
    "sh_rotation_matrix",
]
