"""What [Chen2005] measured: tables 5.2 to 5.17, figures as printed.

Clustering seconds, average overdraw and average squared error of the four methods, in the order of
`METHODS`; the dino has no fourth row.
"""

from dataclasses import dataclass

METHODS = ("cpca", "reclassified", "coherent", "both")
"""Original CPCA; CPCA overdraw reduction; Chen's method; the last two together."""


@dataclass(frozen=True)
class Thesis:
    """One table: its number, and (seconds, overdraw, squared error) of each method."""

    number: str
    rows: dict[str, tuple[float, float, float]]


def _table(number: str, *rows: tuple[float, float, float]) -> Thesis:
    return Thesis(number, dict(zip(METHODS, rows, strict=False)))


THESIS: dict[tuple[str, int], Thesis] = {
    ("dino-phong", 64): _table(
        "5.2", (233, 1.427584, 0.033846), (342, 1.383141, 0.032895), (138, 1.309619, 0.047968)
    ),
    ("dino-phong", 128): _table(
        "5.4", (758, 1.556363, 0.014452), (737, 1.505114, 0.014756), (250, 1.359051, 0.027246)
    ),
    ("dino-phong", 192): _table(
        "5.5", (915, 1.637316, 0.007938), (1186, 1.593019, 0.008764), (295, 1.382953, 0.017335)
    ),
    ("dino-phong", 256): _table(
        "5.3", (1624, 1.733425, 0.005371), (1647, 1.646063, 0.006344), (451, 1.404810, 0.012216)
    ),
    ("horse-phong", 64): _table(
        "5.6", (226, 1.510882, 0.029795), (259, 1.449997, 0.029944),
        (344, 1.417578, 0.029789), (270, 1.344148, 0.030263),
    ),
    ("horse-phong", 128): _table(
        "5.8", (700, 1.664971, 0.014491), (466, 1.599350, 0.016006),
        (958, 1.506927, 0.014509), (369, 1.474205, 0.015547),
    ),
    ("horse-phong", 192): _table(
        "5.9", (831, 1.739609, 0.009147), (766, 1.673963, 0.009875),
        (1077, 1.570583, 0.009132), (834, 1.511764, 0.010184),
    ),
    ("horse-phong", 256): _table(
        "5.7", (960, 1.825407, 0.006340), (1016, 1.724545, 0.007333),
        (1217, 1.632803, 0.006301), (820, 1.574815, 0.007226),
    ),
    ("horse-cook-torrance", 64): _table(
        "5.10", (215, 1.518691, 0.258778), (258, 1.469621, 0.255928),
        (319, 1.408963, 0.258831), (184, 1.378961, 0.259388),
    ),
    ("horse-cook-torrance", 128): _table(
        "5.12", (434, 1.643282, 0.136315), (489, 1.608796, 0.137434),
        (621, 1.519724, 0.136325), (562, 1.457983, 0.136876),
    ),
    ("horse-cook-torrance", 192): _table(
        "5.13", (648, 1.729105, 0.089433), (624, 1.696131, 0.093385),
        (843, 1.584186, 0.089484), (724, 1.560885, 0.092139),
    ),
    ("horse-cook-torrance", 256): _table(
        "5.11", (863, 1.799159, 0.064937), (1016, 1.755126, 0.069018),
        (1085, 1.640612, 0.064994), (1157, 1.592372, 0.064323),
    ),
    ("bunny-cook-torrance", 64): _table(
        "5.15", (340, 1.305410, 0.221043), (438, 1.275172, 0.224016),
        (606, 1.239781, 0.221096), (434, 1.207974, 0.225144),
    ),
    ("bunny-cook-torrance", 128): _table(
        "5.16", (766, 1.412708, 0.118658), (908, 1.345726, 0.117374),
        (1179, 1.300917, 0.118617), (1037, 1.285856, 0.113184),
    ),
    ("bunny-cook-torrance", 192): _table(
        "5.17", (1339, 1.471411, 0.073271), (1165, 1.420354, 0.076507),
        (1912, 1.356309, 0.073280), (1355, 1.337691, 0.077189),
    ),
    ("bunny-cook-torrance", 256): _table(
        "5.14", (1609, 1.529308, 0.054466), (1886, 1.467294, 0.058319),
        (2293, 1.413759, 0.054501), (2087, 1.378627, 0.055894),
    ),
}  # fmt: skip
