"""
Work and precision, against a projection by hand
================================================

Without dvax one writes the projection into the right-hand side and calls an integrator of SciPy.
It is the same equation, but the integrator finds the kinks by rejected steps. Both sides count
what an evaluation of the law costs.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.integrate

import dvax

jax.config.update("jax_enable_x64", True)


def load(t, where):
    return 4.0 * where.sin(5.0 * t)


problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, 1.0),
    f=lambda t, x, u, args: load(t, jnp) - 2.0 * u,
    h=lambda t, x, u, args: 5.0 * x,
)


def by_hand(t, x):
    return -x + load(t, np) - 2.0 * np.clip(5.0 * x, 0.0, 1.0)


reference = float(dvax.solve(problem, 0.0, 0.0, 10.0, rtol=1e-13, atol=1e-14).xs[-1])
tolerances = 10.0 ** -np.arange(4.0, 11.0)
ours, scipys = [], {"RK45": [], "DOP853": [], "LSODA": []}
for tol in tolerances:
    sol = dvax.solve(problem, 0.0, 0.0, 10.0, rtol=tol, atol=tol, method=dvax.DormandPrince())
    ours.append((int(sol.stats["evaluations"]), abs(float(sol.xs[-1]) - reference)))
    for method, points in scipys.items():
        run = scipy.integrate.solve_ivp(by_hand, (0.0, 10.0), [0.0], method, rtol=tol, atol=tol)
        points.append((run.nfev, abs(run.y[0, -1] - reference)))

# %%

figure, axes = plt.subplots()
axes.loglog(*zip(*ours, strict=True), "o-", label="dvax, DormandPrince")
for (method, points), marker in zip(scipys.items(), "s^v", strict=True):
    axes.loglog(*zip(*points, strict=True), marker + "--", label=f"SciPy, {method}")
axes.set(xlabel="evaluations of the law", ylabel="error at t = 10", title="Work and precision")
axes.legend()

# %%
# The certificate
# ---------------
#
# The loop by hand has no bound on its error. That of dvax:

check = dvax.verify(problem, 0.0, 0.0, 10.0)
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions: {check.status}")
print(f"error at the tightest tolerance: at most {float(bound.x[-1]):.0e} ({bound.status})")
