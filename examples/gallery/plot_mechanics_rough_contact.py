"""
A rough body on rubber: contact that remembers
==============================================

A rough rigid body is pressed into a thick layer of rubber, held, and pulled off again. The rubber
creeps: its displacement x follows the elastic one, u, within τ = 10 s. The pressure p of all points
moves each point, by a convolution. While the body is held, the pressure relaxes and the contact stays
as it is. When it is pulled off, the surface lags behind: at an equal approach the area is smaller.

::

    τ x' = −x + c u,    u + x ≥ δ(t) + r,    p = P u ≥ 0,    p (u + x − δ − r) = 0
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
n, length, tau = 64, 200.0, 10.0  # points, μm, s
rng = np.random.default_rng(4)
k = np.hypot(np.fft.fftfreq(n, 1 / n)[:, None], np.fft.rfftfreq(n, 1 / n))
waves = np.where((k >= 2) & (k <= 12), np.maximum(k, 1.0) ** -1.8, 0.0)
heights = np.fft.irfft2(waves * np.exp(2j * np.pi * rng.random(k.shape)), (n, n))
heights = heights / heights.std()  # 1 μm

times = jnp.array([0.0, 2.0, 22.0, 24.0])
approach = dvax.signals.Table(times, jnp.array([0.0, 5.0, 5.0, 0.0]), kind="linear")  # μm
model = dvax.models.RoughContact(
    profile=heights, lengths=length, modulus=10.0, thickness=2 * length, approach=approach,
    creep=2.0, retardation_time=tau,
)  # fmt: skip
ts = np.linspace(0.0, 24.0, 97)
sol = dvax.solve(
    model.problem,
    model.untouched,
    0.0,
    24.0,
    ts=ts,
    constants=model.constants,
    rtol=1e-3,
    atol=1e-2,
)

# %%
# Left: the pressure when the approach has just reached 5 μm. Right: the contact area over the approach,
# on the way in and out.

figure, (left, right) = plt.subplots(1, 2, layout="constrained")
pressure = np.asarray(sol.ys)
image = left.imshow(
    np.where(pressure[8] > 0, pressure[8], np.nan), extent=(0, length, 0, length), origin="lower",
    cmap="viridis",
)  # fmt: skip
left.set(xlabel="s₁ [μm]", ylabel="s₂ [μm]", title="In contact at t = 2 s")
figure.colorbar(image, ax=left, label="pressure [MPa]", shrink=0.7)
area = 100 * np.mean(pressure > 0, axis=(1, 2))
depth = np.array([float(approach(t)) for t in ts])
hold, out = ts >= 2.0, ts >= 22.0
right.plot(depth[~hold | (ts == 2.0)], area[~hold | (ts == 2.0)], label="pressed in")
right.plot(depth[out], area[out], linestyle="--", label="pulled off after 20 s")
right.set(xlabel="approach δ [μm]", ylabel="contact area [%]", title="Hysteresis")
right.legend()

# %%
# While the body is held, the pressure relaxes with a closed form, and the contact keeps its points.

mean = pressure.mean(axis=(1, 2))
print(f"mean pressure at t = 2 s: {mean[8]:.4f} MPa, at t = 22 s: {mean[88]:.4f} MPa")
print(f"contact area at both times: {area[8]:.2f} % and {area[88]:.2f} %")

# %%
# The certificate
# ---------------
#
# Any two states approach with the rate 1/τ, whatever the contact does: normal cones are monotone.

bound = dvax.bound_error(model.problem, sol, model.constants)
rate = float(-model.constants.one_sided)
print(f"rate of approach: {rate:.2f} per second ({dict(model.constants.statuses)['one_sided']})")
relative = float(bound.x[-1] / model.space.norm(sol.xs[-1]))
print(f"error of the creep at the end, in the energy norm: at most {relative:.1%} ({bound.status})")
