import numpy as np
import pytest

from prtbake_workers.validation.budget import ChainPicture, make_budget, pool_budgets

HITS = 400


def noisy(rng, picture, n_passes, sigma):
    return picture + sigma * rng.standard_normal((n_passes, *picture.shape))


@pytest.fixture
def truth(rng):
    return 1.0 + rng.random((HITS, 3))


def test_lines_of_a_known_chain_are_found(rng, truth):
    step = 0.01 * rng.standard_normal(truth.shape)
    chain = [ChainPicture("reference", truth[None]), ChainPicture("a", (truth + step)[None])]
    budget = make_budget(chain)
    expected = np.linalg.norm(step) / np.linalg.norm(truth)
    assert budget.lines[0].error == pytest.approx(expected, rel=1e-12)
    assert budget.total == pytest.approx(expected, rel=1e-12)


def test_the_variance_of_the_reference_is_subtracted(rng, truth):
    """Noise ten times the true step: the estimate still finds it, the plain difference does not."""
    step = 0.01 * rng.standard_normal(truth.shape)
    passes = noisy(rng, truth, 64, 0.2)
    plain = np.linalg.norm(passes.mean(axis=0) - truth - step) / np.linalg.norm(truth)
    budget = make_budget(
        [ChainPicture("reference", passes), ChainPicture("asset", (truth + step)[None])]
    )
    expected = np.linalg.norm(step) / np.linalg.norm(truth)
    # standard error of the subtracted square is sqrt(2 / 1200) of the noise's square, 6.3 x the step's
    assert budget.total == pytest.approx(expected, rel=0.35)
    assert plain > 2.0 * expected  # the negative twin: without the subtraction it is wrong


def test_shared_samples_cancel_in_a_line(rng, truth):
    noise = 0.3 * rng.standard_normal((16, *truth.shape))
    step = 0.001 * np.ones_like(truth)
    budget = make_budget(
        [ChainPicture("reference", truth + noise), ChainPicture("terms", truth + noise + step)]
    )
    expected = np.linalg.norm(step) / np.linalg.norm(truth)
    assert budget.lines[0].error == pytest.approx(expected, rel=0.01)  # of the norm's own noise
    assert budget.lines[0].noise < 1e-12


def test_a_difference_of_pure_noise_is_marked_as_such(rng, truth):
    chain = [
        ChainPicture("reference", noisy(rng, truth, 8, 0.1)),
        ChainPicture("same", noisy(rng, truth, 8, 0.1)),
    ]
    assert make_budget(chain).lines[0].below_noise


@pytest.mark.parametrize("steps", ["orthogonal", "parallel", "cancelling"])
def test_the_total_is_measured_end_to_end(truth, steps):
    """Not from the lines: equal lines have a total of their root, their sum, or nothing."""
    size = 0.02 * np.linalg.norm(truth)
    first, second = np.zeros_like(truth), np.zeros_like(truth)
    first[0, 0] = size
    second[(1, 0) if steps == "orthogonal" else (0, 0)] = -size if steps == "cancelling" else size
    pictures = [truth, truth + first, truth + first + second]
    budget = make_budget([ChainPicture(str(i), p[None]) for i, p in enumerate(pictures)])
    assert [line.error for line in budget.lines] == pytest.approx([0.02, 0.02], rel=1e-9)
    assert budget.sum_of_lines == pytest.approx(0.04, rel=1e-9)
    expected = {"orthogonal": 0.02 * np.sqrt(2.0), "parallel": 0.04, "cancelling": 0.0}[steps]
    assert budget.total == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_a_black_scene_has_no_error(truth):
    black = np.zeros((1, HITS, 3))
    budget = make_budget([ChainPicture("reference", black), ChainPicture("asset", black)])
    assert budget.total == 0.0
    assert pool_budgets([budget, budget]).total == 0.0


def test_a_black_reference_is_said(truth):
    """Nothing to be relative to: lines are relative to the brightest picture, and it is flagged."""
    black = ChainPicture("reference", np.zeros((1, HITS, 3)))
    budget = make_budget(
        [black, ChainPicture("a", truth[None]), ChainPicture("b", truth[None] / 2)]
    )
    assert budget.black_reference
    assert [line.error for line in budget.lines] == pytest.approx([1.0, 0.5], rel=1e-12)
    assert budget.total == pytest.approx(0.5, rel=1e-12)
    lit = make_budget([ChainPicture("reference", truth[None]), ChainPicture("a", truth[None])])
    assert not lit.black_reference


def test_a_picture_with_a_black_reference_adds_its_difference_and_no_norm(truth):
    black, lit = np.zeros_like(truth), 3.0 * truth
    dark = make_budget([ChainPicture("r", black[None]), ChainPicture("x", truth[None])])
    seen = make_budget([ChainPicture("r", lit[None]), ChainPicture("x", 1.1 * lit[None])])
    pooled = pool_budgets([dark, seen])
    together = np.concatenate([black, lit]), np.concatenate([truth, 1.1 * lit])
    expected = np.linalg.norm(together[1] - together[0]) / np.linalg.norm(together[0])
    assert not pooled.black_reference
    assert pooled.total == pytest.approx(expected, rel=1e-12)
    assert pool_budgets([dark, dark]).black_reference


def test_pooling_is_the_norm_over_all_pixels(rng, truth):
    steps = [0.01 * rng.standard_normal(truth.shape), 0.05 * rng.standard_normal(truth.shape)]
    bright = 10.0 * truth
    pairs = [(truth, truth + steps[0]), (bright, bright + steps[1])]
    pooled = pool_budgets(
        [make_budget([ChainPicture("r", a[None]), ChainPicture("x", b[None])]) for a, b in pairs]
    )
    together = np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
    expected = np.linalg.norm(together[1] - together[0]) / np.linalg.norm(together[0])
    assert pooled.total == pytest.approx(expected, rel=1e-12)


def test_a_picture_that_shows_nothing_hides_no_noise(rng, truth):
    """Pooled with an empty picture, pure noise is still marked, in the line and in the total."""
    noise = make_budget(
        [
            ChainPicture("reference", noisy(rng, truth, 8, 0.1)),
            ChainPicture("same", noisy(rng, truth, 8, 0.1)),
        ]
    )
    empty = make_budget(
        [ChainPicture("reference", np.zeros((1, 0, 3))), ChainPicture("same", np.zeros((1, 0, 3)))]
    )
    pooled = pool_budgets([noise, empty])
    assert noise.total_below_noise
    assert pooled.total_below_noise
    assert pooled.lines[0].below_noise
    # negative twin: a step well above the noise is not marked
    step = make_budget(
        [
            ChainPicture("reference", noisy(rng, truth, 8, 0.01)),
            ChainPicture("far", 2.0 * truth[None]),
        ]
    )
    assert not pool_budgets([step, empty]).total_below_noise


def test_pictures_with_other_numbers_of_passes_are_refused(truth):
    with pytest.raises(ValueError, match="2 passes, b 3"):
        make_budget(
            [
                ChainPicture("a", np.repeat(truth[None], 2, 0)),
                ChainPicture("b", np.repeat(truth[None], 3, 0)),
            ]
        )
