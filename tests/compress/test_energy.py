import numpy as np
import pytest

from prtbake_workers.compress.energy import RUN_LENGTH, row_chunks, row_energy

# Each run of squares is added in float32: 6e-8 for each of log2(128) roundings at worst.
RTOL = 5e-7


@pytest.mark.parametrize("n_dims", [1, RUN_LENGTH - 1, RUN_LENGTH, 5 * RUN_LENGTH + 3])
def test_row_energy_is_the_squared_norm(n_dims: int, rng: np.random.Generator) -> None:
    rows = rng.standard_normal((7, n_dims)).astype(np.float32)
    expected = np.sum(rows.astype(np.float64) ** 2, axis=1)
    np.testing.assert_allclose(row_energy(rows), expected, rtol=RTOL)


def test_row_energy_notices_one_wrong_element(rng: np.random.Generator) -> None:
    rows = rng.standard_normal((7, 200)).astype(np.float32)
    expected = np.sum(rows.astype(np.float64) ** 2, axis=1)
    rows[3, 150] += 0.01
    assert not np.allclose(row_energy(rows), expected, rtol=RTOL)


def test_row_energy_of_many_small_terms_beside_a_large_one() -> None:
    # A plain float32 sum loses the small squares next to the large one altogether.
    rows = np.full((1, 1 << 16), 1e-4, dtype=np.float32)
    rows[0, 0] = 10.0
    expected = np.sum(rows.astype(np.float64) ** 2)
    np.testing.assert_allclose(row_energy(rows)[0], expected, rtol=RTOL)


def test_row_energy_of_nothing() -> None:
    assert row_energy(np.zeros((0, 5), np.float32)).shape == (0,)


@pytest.mark.parametrize("n_rows", [0, 1, 10, 11])
def test_chunks_cover_the_rows_once(n_rows: int) -> None:
    rows = np.zeros((n_rows, 4), np.float32)
    covered = [i for chunk in row_chunks(rows, 48) for i in range(chunk.start, chunk.stop)]
    assert covered == list(range(n_rows))
