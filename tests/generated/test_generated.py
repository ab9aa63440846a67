"""Generated problems against SciPy with a hand-written law: the error of a successful run is at most
ten tolerances, bounds are above the error, and no run crashes.

`python -m tests.generated` prints a table of all that fails, and runs one problem alone.
"""

import jax
import numpy as np
import pytest
from tests.selection import mostly_thorough

from . import driver, reference
from .families import FAMILIES
from .sets import SETS

ALWAYS = {
    "Box of one, K vee, open loop": ("DormandPrince",),
    "Box of one, f pulse, open loop": ("ETD4RK",),
    "Box of one, f few squares, h saw": ("default",),
    "Box of one, K tent, Scalar, stiff": ("ExpRosenbrock",),
}
"""Families that run alone, each by one method; `make test` runs one of them."""

FEW = 4


def check(records):
    failures = [
        f'python -m tests.generated --family "{r.family}" --first {r.seed} --samples 1\n'
        f"    {r.method}, rtol {r.rtol:g}, {r.steps} steps: {r.failure}"
        for r in records
        if r.failure
    ]
    assert not failures, f"{len(failures)} failures\n" + "\n".join(failures)


@pytest.mark.parametrize("name", mostly_thorough(ALWAYS, list(ALWAYS)[1:2]))
def test_generated_problems_few(name):
    check([r for k in range(FEW) for r in driver.run(FAMILIES[name], k, ALWAYS[name], k == 0)])


@pytest.mark.thorough
@pytest.mark.parametrize("name", FAMILIES)
def test_generated_problems_many(name):
    jax.clear_caches()  # each family has programs of its own, and memory maps are limited
    family = FAMILIES[name]
    check(
        [
            r
            for k in range(family.samples)
            for r in driver.run(family, k, bounds=k % 4 == 0, certify=k % 20 == 0)
        ]
    )


def test_generated_problems_ten_thousand():
    assert sum(family.samples for family in FAMILIES.values()) >= 10_000


@pytest.mark.parametrize("name", SETS)
def test_reference_projection_is_the_nearest_point(name):
    """⟨z − y, v − y⟩ ≤ 0 for all v of the set, which are projections as well; and some z is outside."""
    kind, rng, moved = SETS[name], np.random.default_rng(1), 0.0
    for _ in range(20):
        p, e = kind.draw(rng), float(rng.uniform(-0.5, 0.9))
        points = 2.0 * rng.normal(size=(12, max(kind.size, 1)))
        nearest = [kind.project(z, p, e) for z in points]
        for z, y in zip(points, nearest, strict=True):
            assert max(float((z - y) @ (v - y)) for v in nearest) <= 1e-12
        moved += float(np.sum(np.abs(np.subtract(points, nearest))))
    assert (moved > 0.0) == (name != "WholeSpace")


def test_reference_solution_of_a_short_contact_is_the_closed_form():
    """x' = min(w, |s − a|) − x/10 in closed form, and as periods that are skipped."""
    a, w, k = 0.4, 0.05, 0.1
    written = reference.Written(
        lambda s, x: np.minimum(w, abs(s - a)) - k * x, np.array([0.5]), 1.0, [a - w, a, a + w]
    )
    found = reference.solve(written, np.array([1.0]))[0, 0]
    ramp = lambda s: np.exp(k * (s - 1.0)) * (s - a - 1.0 / k) / k  # ∫ e^{k(s−1)}(s − a) ds  # noqa: E731
    inside = ramp(a + w) - 2.0 * ramp(a) + ramp(a - w)
    outside = w / k * (1.0 - np.exp(-k) - np.exp(k * (a + w - 1.0)) + np.exp(k * (a - w - 1.0)))
    assert abs(found - (0.5 * np.exp(-k) + inside + outside)) < 1e-11

    wave = lambda s, x: np.sin(np.pi * s) ** 2 - x  # noqa: E731
    periodic = reference.Written(wave, np.array([0.2]), 400.0, [], period=1.0)
    ts = np.array([0.3, 17.3, 391.7, 400.0])
    q = 2 * np.pi
    particular = lambda s: 0.5 - 0.5 * (np.cos(q * s) + q * np.sin(q * s)) / (1 + q * q)  # noqa: E731
    exact = particular(ts) + np.exp(-ts) * (0.2 - particular(0.0))
    assert np.max(np.abs(reference.solve(periodic, ts)[:, 0] - exact)) < 1e-10
