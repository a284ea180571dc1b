"""EMFOA as a general optimiser: known optima, equal budgets, against scipy's differential evolution."""

from __future__ import annotations

import numpy as np
import pytest
from moth_flame_minimiser import emfoa_minimise
from scipy.optimize import differential_evolution

from dynslam_bench.flow.moth_flame import EMFOA, EMFOA_LITERAL, MFO, flame_counts

SHIFT = np.array([1.3, -0.7, 2.1, -1.9])


def sphere(x):
    return ((x - SHIFT) ** 2).sum(-1)


def rastrigin(x):
    z = x - SHIFT
    return 10 * x.shape[-1] + (z**2 - 10 * np.cos(2 * np.pi * z)).sum(-1)


def rosenbrock(x):
    return (100 * (x[..., 1:] - x[..., :-1] ** 2) ** 2 + (1 - x[..., :-1]) ** 2).sum(-1)


def ackley(x):
    z = x - SHIFT
    return -20 * np.exp(-0.2 * np.sqrt((z**2).mean(-1))) - np.exp(np.cos(2 * np.pi * z).mean(-1)) + 20 + np.e


def griewank(x):
    z = 20 * (x - SHIFT)
    return 1 + (z**2).sum(-1) / 4000 - np.prod(np.cos(z / np.sqrt(np.arange(1, x.shape[-1] + 1))), axis=-1)


FUNCTIONS = [sphere, rastrigin, rosenbrock, ackley, griewank]
LOW, HIGH = np.full(4, -5.12), np.full(4, 5.12)
BUDGET = 2000


def solve(fun, seeds=15, **options):
    box = np.tile(LOW, (seeds, 1)), np.tile(HIGH, (seeds, 1))
    return emfoa_minimise(fun, *box, budget=BUDGET, **options)


@pytest.mark.parametrize("fun", FUNCTIONS, ids=lambda f: f.__name__)
def test_comes_near_the_known_optimum_and_beats_random_search(fun):
    found = solve(fun)
    assert found.x.shape == (15, 4)
    np.testing.assert_allclose(fun(found.x), found.value)
    random = fun(np.random.default_rng(0).uniform(LOW, HIGH, (15, BUDGET, 4))).min(axis=1)
    assert np.median(found.value) < np.median(random)
    assert np.median(found.value) >= 0
    limits = {"sphere": 1e-3, "rastrigin": 12.0, "rosenbrock": 4.0, "ackley": 0.6, "griewank": 0.6}
    assert np.median(found.value) < limits[fun.__name__]


@pytest.mark.parametrize("fun", FUNCTIONS, ids=lambda f: f.__name__)
def test_comparable_to_differential_evolution_at_equal_evaluations(fun):
    ours = solve(fun)
    theirs = []
    for seed in range(5):
        result = differential_evolution(
            fun, list(zip(LOW, HIGH, strict=True)), maxiter=BUDGET // 40 - 1, popsize=10, polish=False, rng=seed, tol=0
        )
        assert result.nfev <= BUDGET == ours.evaluations
        theirs.append(result.fun)
    start = np.median(fun(np.random.default_rng(1).uniform(LOW, HIGH, (1000, 4))))
    # same league: what is left of the initial value, on a logarithmic scale, at most three decades apart
    assert np.log10(np.median(ours.value) / start + 1e-9) < np.log10(np.median(theirs) / start + 1e-9) + 3


def test_spends_the_budget_exactly_and_never_rises():
    calls = []

    def counted(x):
        calls.append(x.shape[1])
        return sphere(x)

    for budget in (1, 7, 20, 39, 40, 41, 333):
        calls.clear()
        found = emfoa_minimise(counted, LOW, HIGH, budget=budget)
        assert sum(calls) == found.evaluations == budget
        assert (np.diff(found.history, axis=0) <= 0).all()


def test_problems_do_not_disturb_each_other_and_the_seed_decides():
    goals = np.array([[1.0, 2, 3, 4], [-4, -3, -2, -1]])

    def fun(x):
        return ((x - goals[:, None]) ** 2).sum(-1)

    box = np.tile(LOW, (2, 1)), np.tile(HIGH, (2, 1))
    first, again = (emfoa_minimise(fun, *box, budget=1500, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.x, again.x)
    np.testing.assert_allclose(first.x, goals, atol=0.05)
    assert (emfoa_minimise(fun, *box, budget=1500, seed=4).x != first.x).any()


def test_starts_from_given_positions_and_stays_in_the_box():
    seen = []

    def fun(x):
        seen.append(x.copy())
        return sphere(x)

    found = emfoa_minimise(fun, LOW, HIGH, budget=60, start=SHIFT[None])
    assert found.value[0] == 0
    everything = np.concatenate(seen, axis=1)
    assert (everything >= LOW).all() and (everything <= HIGH).all()


def test_values_that_are_not_numbers_never_win():
    found = emfoa_minimise(lambda x: np.where(x[..., 0] > 0, np.nan, sphere(x)), LOW, HIGH, budget=400)
    assert found.x[0, 0] <= 0 and np.isfinite(found.value[0])


def test_equations_as_printed_are_worse():
    corrected, printed = np.median(solve(sphere).value), np.median(solve(sphere, rules=EMFOA_LITERAL).value)
    assert corrected < 0.1 * printed


def test_flame_counts_follow_equation_11():
    assert flame_counts(30, 100, MFO)[[0, 49, 99]].tolist() == [30, 16, 1]
    printed = flame_counts(30, 100, EMFOA_LITERAL)
    assert printed[19] <= 6 and printed[-1] == 1  # collapses: taken from the last count instead of N
    assert (np.diff(flame_counts(12, 30, EMFOA)) <= 0).all()


def test_refuses_bad_boxes_and_budgets():
    with pytest.raises(ValueError, match="bounds"):
        emfoa_minimise(sphere, HIGH, LOW, budget=10)
    with pytest.raises(ValueError, match="bounds"):
        emfoa_minimise(sphere, LOW * np.nan, HIGH, budget=10)
    with pytest.raises(ValueError, match="budget"):
        emfoa_minimise(sphere, LOW, HIGH, budget=0)


def test_a_start_that_is_not_finite_is_drawn_instead():
    found = emfoa_minimise(lambda x: (x**2).sum(axis=-1), [-5, -5], [5, 5], budget=1, start=[[np.nan, np.inf]])
    assert (np.abs(found.x) <= 5).all()
