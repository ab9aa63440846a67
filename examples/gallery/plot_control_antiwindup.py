"""
A saturated PI controller, with and without anti-windup
========================================================

A heater of at most 5 kW keeps a tank at its set point. A PI controller asks for v = k_p e + z,
and gets u = clip(v, 0, 5). While u is at its limit, the integrator z goes on to grow (it winds
up), and the temperature overshoots. Back-calculation feeds u − v into the integrator::

    x' = (−x + u)/T,       z' = k_i e + b (u − v),       e = r(t) − x

x is the temperature above that of the room, in units of the 1 kW rise; times are in minutes.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
T, k_p, k_i = 10.0, 3.0, 0.8
set_point = dvax.signals.Table([0.0, 1.0, 60.0, 61.0, 120.0], [0.0, 4.0, 4.0, 2.0, 2.0])


def wanted(t, x):
    return k_p * (set_point(t) - x[0]) + x[1]


problem = dvax.Problem(
    A=dvax.generators.Diagonal(jnp.array([-1.0 / T, 0.0])),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, 5.0),
    f=lambda t, x, u, b: jnp.stack([u / T, k_i * (set_point(t) - x[0]) + b * (u - wanted(t, x))]),
    h=lambda t, x, u, b: wanted(t, x),
    control_space=dvax.spaces.Euclidean(()),
)
x0, ts = jnp.zeros(2), np.linspace(0.0, 120.0, 481)
runs = {
    name: dvax.solve(problem, x0, 0.0, 120.0, b, ts=ts, rtol=1e-7, atol=1e-8)
    for name, b in (("no anti-windup", 0.0), ("back-calculation", 0.5))
}

# %%

figure, (top, bottom) = plt.subplots(2, 1, sharex=True)
top.plot(ts, [float(set_point(t)) for t in ts], color="C7", linestyle="--", label="set point")
for name, sol in runs.items():
    top.plot(ts, sol.xs[:, 0], label=name)
    bottom.plot(ts, sol.us, label=name)
top.set(ylabel="temperature rise", title="Saturated PI control of a tank")
top.legend(loc="upper right")
bottom.axhline(5.0, color="C7", linestyle=":")
bottom.set(xlabel="time t [min]", ylabel="power u [kW]")

# %%
# The certificate
# ---------------

check = dvax.verify(problem, x0, 0.0, 120.0, 0.5)
bound = dvax.bound_error(problem, runs["back-calculation"], check.constants)
print(f"assumptions: {check.status}")
print(
    f"rate of the theory: {float(check.constants.growth_rate):.2f} per minute, "
    f"with signs: {float(check.constants.one_sided):.2f}"
)
print(f"error after 20 minutes: at most {float(bound.x[80]):.0e} ({bound.status})")
