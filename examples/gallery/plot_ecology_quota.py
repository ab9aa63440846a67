"""
Predator, prey, and a fishing quota
===================================

Fish (prey x, in 1000 t) and seals (predator y, in 1000) live in a bay. The fleet catches what is
above a protected stock of 0.8, with an effort of 2 per year, but not more than the quota of 0.25
per year::

    x' = x (1 − x/3) − x y/2 − u,     y' = y (x/2 − 0.4),     u = clip(2 (x − 0.8), 0, 0.25)
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)


def rates(t, x, u, quota):
    fish, seals = x
    return jnp.stack([fish * (1 - fish / 3) - fish * seals / 2 - u, seals * (fish / 2 - 0.4)])


problem = dvax.Problem(
    A=dvax.generators.Zero(),
    P=dvax.operators.Scaling(1.0),
    K=lambda t, quota: dvax.sets.Box(0.0, quota),
    f=rates,
    h=lambda t, x, u, quota: 2.0 * (x[0] - 0.8),
    control_space=dvax.spaces.Euclidean(()),
)
x0, ts = jnp.array([2.5, 1.0]), np.linspace(0.0, 40.0, 401)
quotas = [0.0, 0.25, 0.6]
runs = [dvax.solve(problem, x0, 0.0, 40.0, quota, ts=ts, rtol=1e-8, atol=1e-10) for quota in quotas]

# %%

figure, (left, right) = plt.subplots(1, 2)
for quota, sol in zip(quotas, runs, strict=True):
    left.plot(sol.xs[:, 0], sol.xs[:, 1], label=f"{quota:g}")
    right.plot(ts, sol.us)
left.set(xlabel="fish [1000 t]", ylabel="seals [1000]", title="Stocks")
left.legend(title="quota")
right.set(xlabel="time t [years]", ylabel="catch u [1000 t/year]", title="Catch")

# %%
# The certificate
# ---------------
#
# The products of populations have no global Lipschitz constant, so the constants are those of a
# region. The bound proves on its way that the trajectory stays there.

check = dvax.verify(problem, x0, 0.0, 3.0, 0.25, x=(jnp.zeros(2), jnp.array([3.5, 3.0])))
sol = dvax.solve(
    problem,
    x0,
    0.0,
    3.0,
    0.25,
    ts=[1.0, 2.0, 3.0],
    rtol=1e-9,
    atol=1e-12,
    constants=check.constants,
)
bound = dvax.bound_error(problem, sol, check.constants)
print(
    f"assumptions in the region: {check.status}; rate {float(check.constants.one_sided):.2f} per year"
)
for t, error in zip(sol.ts, bound.x, strict=True):
    print(f"error after {float(t):g} years: at most {float(error):.0e} ({bound.status})")
