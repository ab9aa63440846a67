"""
A ball that bounces: events with a reset
========================================

A ball falls through air and bounces on a floor with 80 % of its speed. An impact sets the speed
to another value, which no law in K does: it is an event with a reset. The drag of the air is
limited, as for a parachute that opens up to a size: it is the law, u = clip(0.5 v, −3, 3) in N
for a ball of 1 kg.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
problem = dvax.Problem(
    A=dvax.generators.Zero(),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(-3.0, 3.0),
    f=lambda t, x, u, args: jnp.stack([x[1], -9.81 - u]),
    h=lambda t, x, u, args: 0.5 * x[1],
    control_space=dvax.spaces.Euclidean(()),
)
impact = dvax.Event(
    lambda t, x, u, args: x[0],
    direction=-1,
    name="impact",
    reset=lambda t, x, u, args: jnp.stack([0.0 * x[0], -0.8 * x[1]]),
)
top = dvax.Event(lambda t, x, u, args: x[1], direction=-1, name="top")
x0, ts = jnp.array([4.0, 0.0]), np.linspace(0.0, 4.0, 801)
sol = dvax.solve(problem, x0, 0.0, 4.0, ts=ts, events=[impact, top], rtol=1e-8, atol=1e-10)

# %%

figure, axes = plt.subplots()
axes.plot(ts, sol.xs[:, 0])
for name, marker in (("impact", "v"), ("top", "o")):
    seen = sol.events.of(name)
    axes.plot(seen.ts, seen.xs[:, 0], marker, label=f"{name} ({len(seen.ts)})")
axes.set(xlabel="time t [s]", ylabel="height [m]", title="A bouncing ball")
axes.legend()
print("times of the impacts [s]:", [f"{t:.4f}" for t in sol.events.of("impact").ts])

# %%
# The certificate
# ---------------
#
# `dvax.bound_error` refuses a run with a reset: the exact trajectory has its impacts at other
# times, and between the two times they differ by the whole jump. Up to the first impact there is
# a bound.

check = dvax.verify(problem, x0, 0.0, 4.0)
try:
    dvax.bound_error(problem, sol, check.constants)
except dvax.InputError as error:
    print(error.problems[0].rule)
flight = dvax.solve(problem, x0, 0.0, float(sol.events.of("impact").ts[0]), rtol=1e-8, atol=1e-10)
bound = dvax.bound_error(problem, flight, check.constants)
print(f"assumptions: {check.status}")
print(f"error of the state at the first impact: at most {float(bound.x[-1]):.0e} ({bound.status})")
