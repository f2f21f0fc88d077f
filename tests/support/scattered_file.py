"""Scattered measurements as text, by the descriptions of both formats."""

import numpy as np

WAVES = np.arange(400.0, 701.0, 20.0)


def goniometer(n_lights=8, n_rings=12):
    """Angles of a goniometer: light in steps of 10 degrees, views on rings, denser outwards."""
    theta_i, theta_o, dphi = [], [], []
    for light in np.deg2rad(10.0 * np.arange(1, n_lights + 1)):
        for ring in range(n_rings):
            n = 1 + 4 * ring
            theta_i += [light] * n
            theta_o += [ring * np.deg2rad(80) / (n_rings - 1)] * n
            dphi += list(2 * np.pi * np.arange(n) / n)
    return np.array(theta_i), np.array(theta_o), np.array(dphi)


def direction(theta, phi):
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def grey_samples(brdf, theta_i, theta_o, dphi):
    """Samples of the first channel."""
    return brdf.eval_brdf(direction(theta_i, 0 * theta_i), direction(theta_o, dphi))[:, 0]


def spectral_text(theta_i, theta_o, dphi, values, waves=WAVES):
    """One spectrum a sample: ``values`` (samples, waves), or grey ones (samples,)."""
    spectra = values if values.ndim == 2 else np.repeat(values[:, None], len(waves), axis=1)
    lines = ["# number of wavelengths", f"{len(waves)}", "# wavelengths"]
    lines.append(" ".join(f"{w:g}" for w in waves))
    rows = np.column_stack([theta_i, 0 * theta_i + 0.3, theta_o, dphi + 0.3, spectra])
    lines += [" ".join(f"{x:.9g}" for x in row) for row in rows]
    return "\n".join(lines).encode()


def alta_text(theta_i, theta_o, dphi, values, output="INV_STERADIAN_COSINE_FACTOR", dim="3 1"):
    lines = ['#SAMPLE "plain"', f"#DIM {dim}", "#VS 0", "#PARAM_IN ISOTROPIC_TL_TV_PROJ_DPHI"]
    lines.append(f"#PARAM_OUT {output}")
    columns = [theta_i, theta_o * np.cos(dphi), theta_o * np.sin(dphi), values]
    lines += [" ".join(f"{x:.12g}" for x in row) for row in np.column_stack(columns)]
    return "\n".join(lines).encode()
