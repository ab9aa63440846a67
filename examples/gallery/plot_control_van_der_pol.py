"""
Van der Pol's oscillator with a saturated brake
===============================================

An oscillator that excites itself is braked by an actuator of limited force. With a force of 1.2
it keeps its limit cycle; with 3 it comes to rest.

::

    x' = v,      v' = (1 − x²) v − x + u,      u = clip(−2 v, −ū, ū)

f has no global Lipschitz constant. `dvax.verify` takes a region of the states instead, and
`dvax.bound_error` proves that the trajectory stays in it, or says that it does not.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
problem = dvax.Problem(
    A=dvax.generators.Dense(jnp.array([[0.0, 1.0], [-1.0, 0.0]])),
    P=dvax.operators.Scaling(1.0),
    K=lambda t, limit: dvax.sets.Box(-limit, limit),
    f=lambda t, x, u, limit: jnp.stack([0.0 * u, (1.0 - x[0] ** 2) * x[1] + u]),
    h=lambda t, x, u, limit: -2.0 * x[1],
    control_space=dvax.spaces.Euclidean(()),
)
x0, ts = jnp.array([2.0, 0.0]), np.linspace(0.0, 20.0, 801)
limits = [0.0, 1.2, 3.0]
runs = [dvax.solve(problem, x0, 0.0, 20.0, limit, ts=ts, rtol=1e-8, atol=1e-10) for limit in limits]

# %%

figure, axes = plt.subplots(figsize=(5.5, 4.5))
for limit, sol in zip(limits, runs, strict=True):
    axes.plot(sol.xs[:, 0], sol.xs[:, 1], label=f"{limit:g}", linewidth=1.2)
axes.set(xlabel="x", ylabel="v", title="Van der Pol's oscillator with a brake")
axes.legend(title="largest force ū")

# %%
# The certificate
# ---------------
#
# The constants hold for x and v between −4 and 4, and while the ball of the bound is in this
# region. The rate is large, so that the bound is of use for short times only.

check = dvax.verify(problem, x0, 0.0, 0.4, 3.0, x=(-4.0, 4.0))
sol = dvax.solve(
    problem, x0, 0.0, 0.4, 3.0, ts=[0.1, 0.2, 0.4], rtol=1e-9, atol=1e-12, constants=check.constants
)
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions in the region: {check.status}; rate {float(check.constants.one_sided):.1f}")
for t, error in zip(sol.ts, bound.x, strict=True):
    print(f"error at t = {float(t):g}: at most {float(error):.0e} ({bound.status})")
