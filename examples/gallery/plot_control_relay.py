"""
A relay thermostat, and its ramp
================================

A relay heats with 2 kW below 20 °C, and with nothing above. Its law jumps, so that it is outside
the class. A controller with a proportional band ε is inside, and tends to the relay as ε → 0::

    C T' = −g (T − T_out(t)) + u,      u = clip(P (20 − T)/ε + P/2, 0, P)

The room has C = 0.5 kWh/K and loses g = 0.1 kW/K. With the bands below, the temperature of the
room settles a part of ε away from 20 °C, and the power follows the weather, as that of a relay
does in the mean.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
C, g, power = 0.5, 0.1, 2.0


def outdoor(t):
    return 5.0 + 6.0 * jnp.sin(2 * jnp.pi * (t - 9.0) / 24.0)


problem = dvax.Problem(
    A=dvax.generators.Scalar(-g / C),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, power),
    f=lambda t, x, u, eps: (g * outdoor(t) + u) / C,
    h=lambda t, x, u, eps: power * (20.0 - x) / eps + power / 2,
)
ts = np.linspace(0.0, 48.0, 481)
bands = [4.0, 1.0, 0.1]
runs = [dvax.solve(problem, 15.0, 0.0, 48.0, eps, ts=ts, rtol=1e-7, atol=1e-7) for eps in bands]

# %%

figure, (top, bottom) = plt.subplots(2, 1, sharex=True)
for eps, sol in zip(bands, runs, strict=True):
    top.plot(ts, sol.xs, label=f"ε = {eps:g} K")
    bottom.plot(ts, sol.us)
top.set(ylabel="temperature [°C]", title="A thermostat with a proportional band")
top.legend(loc="lower right")
bottom.set(xlabel="time t [h]", ylabel="power u [kW]")

# %%
# The certificate
# ---------------
#
# The heating decreases with the temperature, so two rooms approach at least with the rate g/C,
# for every ε.

check = dvax.verify(problem, 15.0, 0.0, 48.0, bands[-1])
bound = dvax.bound_error(problem, runs[-1], check.constants)
print(f"assumptions for ε = {bands[-1]:g} K: {check.status}")
print(f"two rooms approach with {-float(check.constants.one_sided):.2f} per hour")
print(f"error of the temperature: at most {float(bound.x.max()):.0e} K ({bound.status})")
