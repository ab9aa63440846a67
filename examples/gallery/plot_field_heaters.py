"""
Heat with limited heaters
=========================

A plate with cold walls has a heater at every point. Each heater follows the temperature that is
missing there, up to its greatest power. A flame moves to and fro over the plate. Three regions
form: full power, regulation, and off. `dvax.models.Thermostat` states the equations.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

import dvax
from dvax.models import Thermostat

jax.config.update("jax_enable_x64", True)


def flame(t):
    return 1.5 * jnp.exp(-30.0 * ((s1 - 0.5 - 0.3 * jnp.sin(t)) ** 2 + (s2 - 0.5) ** 2))


plate = Thermostat(
    shape=(48, 32),
    lengths=(1.5, 1.0),
    boundary="dirichlet",
    diffusion=0.05,
    gain=6.0,
    reference=1.0,
    lower=0.0,
    upper=2.0,
    load=flame,
)
s1, s2 = plate.points
ts = np.linspace(0.0, 6.0, 7)
sol = dvax.solve(plate.problem, jnp.zeros((48, 32)), 0.0, 6.0, ts=ts, rtol=1e-4, atol=1e-6)

# %%

colours, words = ["#0072B2", "#F0E442", "#D55E00"], ["off", "regulating", "full power"]
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6))
extent = (0.0, 1.5, 0.0, 1.0)
image = left.imshow(sol.xs[-1].T, origin="lower", extent=extent, cmap="inferno")
figure.colorbar(image, label="temperature", shrink=0.8)
regimes = np.asarray(plate.regimes(ts[-1], sol.xs[-1])) + 1
right.imshow(
    regimes.T, origin="lower", extent=extent, cmap=ListedColormap(colours), vmin=-0.5, vmax=2.5
)
right.legend(
    handles=[Patch(color=c, label=w) for c, w in zip(colours, words, strict=True)],
    ncols=3,
    loc="upper center",
    bbox_to_anchor=(0.5, -0.2),
    frameon=False,
)
for axes, title in ((left, "Temperature at t = 6"), (right, "Heaters at t = 6")):
    axes.set(title=title, xlabel="s₁", ylabel="s₂")
    axes.grid(False)

# %%
# The certificate
# ---------------

constants = plate.constants
bound = dvax.bound_error(plate.problem, sol, constants)
print(f"constants: {constants.status_of('gamma', 'L_F', 'one_sided')}")
print(f"two plates approach with the rate {float(constants.sharp_decay_rate):.3f}")
print(f"error of the temperature in L²: at most {float(bound.x.max()):.0e} ({bound.status})")
