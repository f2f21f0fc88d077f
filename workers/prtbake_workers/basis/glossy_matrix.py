"""The glossy transfer matrix of [Sloan2003]: source light to exitant radiance, in local frames."""

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.hemisphere_basis import HemisphereBasis
from prtbake_workers.basis.sh_rotation import rotate_sh


def glossy_matrix(
    brdf: Float64[F64, "out_coeffs in_coeffs"],
    transfer: Float64[F64, "... rows light_coeffs"],
    frames: Float64[F64, "... 3 3"],
    *,
    incident: HemisphereBasis,
    exitant: HemisphereBasis,
) -> Float64[F64, "... out_functions light_coeffs"]:
    """Compose ``M_p = A^-1 B A^-1 R_p T_p``, [Sloan2003]_ eq. (1).

    Parameters
    ----------
    brdf
        ``B_ij = integral over H x H of y_i(v) rho(v, s) s_z y_j(s) ds dv`` in the local frame, for
        all functions of the two orders.
    transfer
        ``T_kj``: transferred incident radiance under the light y_j, projected on y_k in the
        world's axes, zero below the horizon; rows of the order of ``incident``.
    frames
        R_p, world to local: rows tangent, bitangent, normal.
    incident, exitant
        Hemispherical bases between R_p T_p and B, and for the result.

    Returns
    -------
    ndarray
        M_p: its product with the light's coefficients are those of the exitant radiance in
        ``exitant``.  Rows may be fewer than columns, N_r x N_i.

    Raises
    ------
    SettingsError
        B or T does not have the rows and columns of the bases; a frame is no rotation.
    """
    expected = (exitant.order**2, incident.order**2)
    if brdf.shape != expected:
        raise SettingsError(f"the BRDF matrix must be {expected}, got {brdf.shape}")
    if transfer.shape[-2] != incident.order**2:
        raise SettingsError(
            f"transfer must have {incident.order**2} rows, got {transfer.shape[-2]}"
        )
    # transposed throughout: the rotation and both A^-1 act on the last axis
    local = rotate_sh(np.swapaxes(transfer, -1, -2), frames[..., None, :, :])
    reflected = exitant.from_zero_hemisphere(brdf[:, incident.kept].T)
    return np.swapaxes(incident.from_zero_hemisphere(local) @ reflected, -1, -2)
