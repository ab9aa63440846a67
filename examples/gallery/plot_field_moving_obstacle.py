"""
A string and a moving obstacle
==============================

A string in honey, fixed at both ends, is pushed up by a round obstacle that moves from left to
right. The obstacle is soft: it pushes with 400 per unit of overlap, and at most with 12.

::

    x_t = 0.1 x_ss + u,      u(t, s) = clip(400 (obstacle(t, s) − x), 0, 12)

The place where the string leaves the obstacle is a free boundary, which moves.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
n = 128
s = (jnp.arange(n) + 0.5) / n


def obstacle(t):
    return 0.15 - 6.0 * (s - 0.2 - 0.15 * t) ** 2


problem = dvax.Problem(
    A=dvax.generators.Elliptic(n, 1.0, boundary="dirichlet", diffusion=0.1),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, 12.0),
    f=lambda t, x, u, args: u,
    h=lambda t, x, u, args: 400.0 * (obstacle(t) - x),
    state_space=dvax.spaces.L2(jnp.full(n, 1.0 / n)),
    control_space=dvax.spaces.L2(jnp.full(n, 1.0 / n)),
)
x0, ts = jnp.zeros(n), np.linspace(0.0, 4.0, 81)
sol = dvax.solve(problem, x0, 0.0, 4.0, ts=ts, rtol=1e-5, atol=1e-6, method=dvax.ETD2RK())

# %%

figure, (left, right) = plt.subplots(1, 2)
for number, k in enumerate((10, 40, 80)):
    left.plot(s, sol.xs[k], color=f"C{number}", label=f"t = {ts[k]:g}")
    left.plot(s, obstacle(ts[k]), color=f"C{number}", linestyle=":", linewidth=1)
left.set(
    ylim=(0.0, 0.2), xlabel="place s", ylabel="height x", title="String (line), obstacle (dots)"
)
left.legend(loc="upper left")
image = right.imshow(sol.us, origin="lower", aspect="auto", extent=(0, 1, 0, 4), cmap="cividis")
right.set(xlabel="place s", ylabel="time t", title="Push of the obstacle")
right.grid(False)
figure.colorbar(image, label="u")

# %%
# The certificate
# ---------------
#
# The law is a clip at every point. ETD2RK encloses its defect over whole steps, so that the bound
# is proved.

check = dvax.verify(problem, x0, 0.0, 4.0)
bound = dvax.bound_error(problem, sol, check.constants)
print(
    f"assumptions: {check.status}; two strings approach with the rate "
    f"{-float(check.constants.one_sided):.3f}"
)
print(f"error of the string in L²: at most {float(bound.x.max()):.0e} ({bound.status})")
