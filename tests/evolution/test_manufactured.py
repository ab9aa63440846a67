"""Manufactured solutions for combinations of generators, operators and sets."""

import numpy as np
import pytest
from tests.evolution.test_order import slope
from tests.manufactured import GENERATORS, OPERATORS, SETS, manufactured

import dvax

# Every set, every operator and every generator, in turn.
CASES = [
    (list(GENERATORS)[(5 * i) % len(GENERATORS)], list(OPERATORS)[i % len(OPERATORS)], kind)
    for i, kind in enumerate(SETS)
]
STIFF = ("Diagonal, stiff", "Elliptic")
"""Where h‖A‖ is far above 1 and f̃ does not commute with A, order 3 is what ETD4RK promises."""
TS = np.linspace(0.0, 1.5, 7)


@pytest.mark.thorough
@pytest.mark.parametrize(("generator", "operator", "kind"), CASES)
def test_manufactured_solution_is_reached_with_the_nominal_order(generator, operator, kind):
    made = manufactured(generator, operator, kind)
    for method, counts in ((dvax.ETD2RK(), [32, 64, 128, 256]), (dvax.ETD4RK(), [16, 32, 64, 128])):
        errors = []
        for count in counts:
            sol = dvax.solve(
                made.problem, made.x0, 0.0, 1.5, ts=TS, dt=1.5 / count, max_steps=300, method=method
            )
            errors.append(made.error(sol))
        of_x, of_u = np.array(errors).T
        # Where rounding takes over, an order is no more to be seen.
        seen = of_x > 3e-13
        found = slope(np.array(counts)[seen], of_x[seen]) if np.sum(seen) > 2 else np.nan
        print(
            f"{generator}, {operator}, {kind}: order {found:.2f} of {method.order}; {of_x}, {of_u}"
        )
        assert of_x[-1] <= 30.0 * counts[-1] ** -float(method.order)
        assert of_u[-1] <= 10.0 * of_x[-1] + 1e-10
        # Kinks lie anywhere in the steps, and the fastest of the generators is not resolved by the
        # first of them: an order is seen through that, not measured to a tenth.
        least = min(method.order, 3) - 0.7 if generator in STIFF else method.order - 0.5
        assert np.isnan(found) or found >= least
