"""
A map of stability
==================

Do two trajectories of the contact law approach each other? The paper proves it where the damping
α exceeds the Lipschitz constant of the reduced right-hand side, d_x + d_u b_x/(1 + b_u). That
constant adds absolute values. The rate with signs, α + d_x − d_u b_x/(1 + b_u), counts d_x as the
damping that it is, and proves the decay for more parameters.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
damping, stiffness = np.linspace(0.1, 4.0, 14), np.linspace(0.1, 4.0, 14)


def rates(alpha, b_x):
    model = dvax.models.Contact(
        alpha=alpha, beta=1.0, b_x=b_x, b_u=0.5, d_x=0.8, d_u=1.0, kappa0=0.5, g=1.0, ell=3.0
    )
    return float(model.constants.decay_rate), float(model.constants.sharp_decay_rate)


table = np.array([[rates(a, b) for a in damping] for b in stiffness])

# %%

figure, panels = plt.subplots(1, 2, sharey=True, figsize=(9, 3.8))
limit = np.abs(table).max()
for axes, values, title in zip(
    panels, np.moveaxis(table, 2, 0), ("of the paper", "with signs"), strict=True
):
    image = axes.pcolormesh(damping, stiffness, values, cmap="PuOr", vmin=-limit, vmax=limit)
    axes.contour(damping, stiffness, values, levels=[0.0], colors="black")
    axes.set(xlabel="damping α", title=f"Proved decay rate {title}")
    axes.grid(False)
panels[0].set_ylabel("stiffness b_x")
figure.colorbar(image, ax=panels, label="rate (above 0: trajectories approach)")

# %%
# The certificate
# ---------------
#
# Two trajectories at a point where only the rate with signs is positive: their distance is below
# its exponential.

model = dvax.models.Contact(
    alpha=0.5, beta=1.0, b_x=0.6, b_u=0.5, d_x=0.8, d_u=1.0, kappa0=0.5, g=1.0, ell=3.0
)
ts = np.linspace(0.0, 3.0, 31)
first, second = (dvax.solve(model.problem, x, 0.0, 3.0, ts=ts, rtol=1e-7) for x in (-1.0, 1.0))
rate = float(model.constants.sharp_decay_rate)
distance = np.abs(np.asarray(first.xs - second.xs))
bound = dvax.bound_error(model.problem, first, model.constants)
print(f"constants: {model.constants.status_of('gamma', 'one_sided')}, rate {rate:.3f}")
print("within the proved decay:", bool(np.all(distance <= 2.0 * np.exp(-rate * ts) + 1e-6)))
print(f"error of the first run: at most {float(np.max(bound.x)):.0e} ({bound.status})")
