"""
A steel bar in growing cycles
=============================

A steel point is strained to and fro with growing amplitude. The stress stays close to von Mises'
yield stress of 250 MPa, and the faster the cycle, the larger the overstress (the law of Duvaut
and Lions, relaxation time 50 ms).
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax
from dvax.models.duvaut_lions import DuvautLions, VonMises, mandel

jax.config.update("jax_enable_x64", True)
shear = mandel(jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))


def angle(t):  # the shear strain, without a unit
    return 6e-4 * t * jnp.sin(2 * jnp.pi * t)


steel = DuvautLions(
    bulk=160e3,
    shear=80e3,
    relaxation=0.05,
    yields=VonMises(250.0),
    strain=lambda t: angle(t) * shear,
)
ts = np.linspace(0.0, 5.0, 501)
sol = dvax.solve(steel.problem, steel.virgin, 0.0, 5.0, ts=ts, rtol=1e-5, atol=1e-8)

# %%
# Yield in shear is at 250/√3 MPa.

stress = np.array([steel.stress(t, x)[5] for t, x in zip(ts, sol.xs, strict=True)]) / np.sqrt(2)
figure, axes = plt.subplots()
path = axes.scatter(1e3 * angle(ts), stress, c=ts, s=6, cmap="cividis")
for side in (-1, 1):
    axes.axhline(side * 250 / np.sqrt(3), color="C7", linestyle="--", linewidth=1)
axes.set(xlabel="shear strain [‰]", ylabel="shear stress [MPa]", title="Cycles of a steel point")
figure.colorbar(path, label="time t [s]")

# %%
# The certificate
# ---------------

check = dvax.verify(steel.problem, steel.virgin, 0.0, 5.0)
bound = dvax.bound_error(steel.problem, sol, check.constants)
print(f"assumptions: {check.status}")
print(
    f"error of the state: at most {float(bound.x.max()):.0e} √MPa in the energy norm ({bound.status})"
)
