"""Generators with operators and sets, on solutions that were chosen first."""

import numpy as np
import pytest
from tests.evolution.test_order import slope
from tests.manufactured import GENERATORS, OPERATORS, SETS, manufactured
from tests.selection import mostly_thorough

import dvax

# Every set with every operator, and every generator with every operator and with most sets.
CASES = [
    (list(GENERATORS)[(2 * i + 3 * j) % len(GENERATORS)], operator, kind)
    for i, kind in enumerate(SETS)
    for j, operator in enumerate(OPERATORS)
]
OFTEN = [("Zero", "Scaling", "Box"), CASES[3]]
TS = np.linspace(0.0, 1.5, 7)


@pytest.mark.parametrize(("generator", "operator", "kind"), mostly_thorough(CASES, OFTEN))
def test_the_chosen_solution_comes_out_at_the_nominal_order(generator, operator, kind):
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
        print(f"{generator}, {operator}, {kind}: order {found:.2f} of {method.order}; {of_x}, {of_u}")
        assert of_x[-1] <= 30.0 * counts[-1] ** -float(method.order)
        assert of_u[-1] <= 20.0 * of_x.max(initial=1e-12) + 1e-9
        assert np.isnan(found) or found >= method.order - 0.15
