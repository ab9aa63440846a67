"""
A pendulum and a weak motor
===========================

A motor of at most 2 N m brings a pendulum of 1 m and 1 kg with friction to rest at 60°, where
gravity needs 8.5 N m: it fails, and the pendulum hangs where the motor is at its limit. With 10 N
m it succeeds. The law is the saturation of a controller with feed-forward,

::

    θ'' = −9.81 sin θ − 2 θ' + u,      u = clip(9.81 sin θ_r + 8 (θ_r − θ) − 2 θ', −ū, ū)
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
goal = np.pi / 3

problem = dvax.Problem(
    A=dvax.generators.Dense(jnp.array([[0.0, 1.0], [0.0, -2.0]])),
    P=dvax.operators.Scaling(1.0),
    K=lambda t, limit: dvax.sets.Box(-limit, limit),
    f=lambda t, x, u, limit: jnp.stack([0.0 * u, -9.81 * jnp.sin(x[0]) + u]),
    h=lambda t, x, u, limit: 9.81 * np.sin(goal) + 8.0 * (goal - x[0]) - 2.0 * x[1],
    control_space=dvax.spaces.Euclidean(()),
)
x0, ts = jnp.zeros(2), np.linspace(0.0, 6.0, 301)
limits = [2.0, 10.0]
runs = [dvax.solve(problem, x0, 0.0, 6.0, limit, ts=ts, rtol=1e-8, atol=1e-9) for limit in limits]

# %%

figure, (left, right) = plt.subplots(1, 2)
for limit, sol in zip(limits, runs, strict=True):
    left.plot(ts, np.degrees(sol.xs[:, 0]), label=f"{limit:g} N m")
    right.plot(ts, sol.us)
left.axhline(60.0, color="C7", linestyle="--")
left.set(xlabel="time t [s]", ylabel="angle θ [°]", title="Pendulum")
left.legend(title="motor")
right.set(xlabel="time t [s]", ylabel="torque u [N m]", title="Motor")

# %%
# The certificate
# ---------------
#
# The sine has the slope 1 at most, so that all moduli are proved without a region. The rate is
# positive: gravity may separate two motions, and the bound grows with time.

check = dvax.verify(problem, x0, 0.0, 6.0, 10.0)
bound = dvax.bound_error(problem, runs[1], check.constants)
print(f"assumptions: {check.status}")
print(f"rate with signs {float(check.constants.one_sided):.2f} per second")
for t in (0.26, 0.5, 1.0):
    k = int(np.searchsorted(ts, t))
    print(f"error at t = {t:g} s: at most {float(bound.x[k]):.0e} ({bound.status})")
