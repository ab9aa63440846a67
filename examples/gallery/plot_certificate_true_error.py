"""
The bound and the true error
============================

The contact of one point has a closed form: saturated, then active, then free. For tolerances from
10⁻³ to 10⁻⁹ the true error is below the tolerance, and the proved bound is above the true error,
as it must be.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, 0.5),
    f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
)
ts = np.linspace(0.0, 2.0, 41)
t1 = np.log(8 / 5) / 1.5  # leaves the bound 1/2: x = 0 there
t2 = t1 + 2 * np.log(10 / 9)  # leaves contact: x = 1/2 there
exact = np.where(
    ts < t1,
    5 / 3 - 8 / 3 * np.exp(-1.5 * ts),
    np.where(ts < t2, 5 - 5 * np.exp(-(ts - t1) / 2), 2 - 1.5 * np.exp(-1.5 * (ts - t2))),
)
check = dvax.verify(problem, -1.0, 0.0, 2.0)
tolerances = 10.0 ** -np.arange(3.0, 10.0)
errors, bounds = [], []
for tol in tolerances:
    sol = dvax.solve(problem, -1.0, 0.0, 2.0, ts=ts, rtol=tol, atol=tol, method=dvax.ETD2RK())
    bound = dvax.bound_error(problem, sol, check.constants)
    errors.append(float(np.max(np.abs(np.asarray(sol.xs) - exact))))
    bounds.append(float(np.max(bound.x)))

# %%

figure, axes = plt.subplots()
axes.loglog(tolerances, bounds, "s-", label=f"bound ({bound.status})")
axes.loglog(tolerances, errors, "o-", label="true error")
axes.loglog(tolerances, tolerances, ":", color="C7", label="tolerance")
axes.set(xlabel="tolerance", ylabel="largest error of x", title="Proved bound and true error")
axes.legend()

# %%
# The certificate
# ---------------

print(f"assumptions: {check.status}; bounds: {bound.status}")
print(
    "every bound is above the true error:", all(b >= e for b, e in zip(bounds, errors, strict=True))
)
