"""
A half-wave rectifier, written by hand
======================================

A diode charges a capacitor of 47 µF through 10 Ω from a source of 10 V and 50 Hz; a lamp of 1 kΩ
discharges it. The current of an ideal diode is never negative, and the diode blocks exactly while
it is zero::

    0 ≤ i ⟂ (R i + v − e(t)) ≥ 0,       v' = (i − v/R_L)/C

This is the law with K = [0, ∞) and F(i) = R i + v − e(t): γ = R. Units: V, A, s, Ω, F.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
R, lamp, C = 10.0, 1e3, 47e-6


def source(t):
    return 10.0 * jnp.sin(2 * jnp.pi * 50.0 * t)


problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0 / (lamp * C)),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, jnp.inf),
    f=lambda t, v, i, args: i / C,
    h=lambda t, v, i, args: i - (R * i + v - source(t)),
)
ts = np.linspace(0.0, 0.06, 1201)
sol = dvax.solve(problem, 0.0, 0.0, 0.06, ts=ts, dense=True, rtol=1e-9, atol=1e-9)

# %%

figure, (top, bottom) = plt.subplots(2, 1, sharex=True)
top.plot(1e3 * ts, source(ts), color="C7", linestyle="--", label="source")
top.plot(1e3 * ts, sol.xs, label="capacitor")
top.set(ylabel="voltage [V]", title="Half-wave rectifier")
top.legend(loc="lower left")
bottom.plot(1e3 * ts, 1e3 * sol.us, color="C1")
bottom.set(xlabel="time t [ms]", ylabel="diode current [mA]")
times = np.asarray(sol.regimes().times)
print(
    "the diode switches at [ms]:", [f"{1e3 * t:.4f}" for t in times[(times > 0) & (times < 0.06)]]
)

# %%
# The certificate
# ---------------

check = dvax.verify(problem, 0.0, 0.0, 0.06)
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions: {check.status}; γ = {float(check.constants.gamma):g} Ω")
print(f"error of the voltage: at most {float(bound.x.max()):.0e} V ({bound.status})")
