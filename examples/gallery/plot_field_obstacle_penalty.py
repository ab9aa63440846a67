"""
From a soft to a rigid obstacle
===============================

A membrane is pulled down with the load 8 and held by a flat table 0.5 below it. A rigid table (an
obstacle problem) is outside the class, because its law has γ = 0. A table of stiffness β is
inside, with γ = 1/β. The picture shows how fast it approaches the rigid one, whose steady state
has a closed form: parabolas that touch the table at s = √(1/8).
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
n, load, depth = 128, 8.0, 0.5
s = (np.arange(n) + 0.5) / n


def membrane(beta):
    return dvax.Problem(
        A=dvax.generators.Elliptic(n, 1.0, boundary="dirichlet", diffusion=1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, jnp.inf),
        f=lambda t, x, u, args: u - load,
        h=lambda t, x, u, beta: beta * (-depth - x),
        state_space=dvax.spaces.L2(jnp.full(n, 1.0 / n)),
        control_space=dvax.spaces.L2(jnp.full(n, 1.0 / n)),
    )


problem = membrane(None)
touch = np.sqrt(2 * depth / load)  # the free boundary of the rigid table
near = np.minimum(s, 1.0 - s)
rigid = np.where(near < touch, load / 2 * (near - touch) ** 2 - depth, -depth)
stiffness = [1e2, 1e3, 1e4]
ends = [
    dvax.solve(problem, jnp.zeros(n), 0.0, 2.0, beta, rtol=1e-5, atol=1e-7, method=dvax.ETD2RK())
    for beta in stiffness
]

# %%

figure, (left, right) = plt.subplots(1, 2)
left.plot(s, rigid, color="C7", linewidth=4, alpha=0.4, label="rigid")
for beta, sol in zip(stiffness, ends, strict=True):
    left.plot(s, sol.xs[-1], label=f"β = {beta:g}", linewidth=1)
left.set(xlabel="place s", ylabel="height x", title="Steady states")
left.legend()
distance = [float(np.sqrt(np.mean((np.asarray(sol.xs[-1]) - rigid) ** 2))) for sol in ends]
right.loglog(stiffness, distance, "o-")
right.set(xlabel="stiffness β", ylabel="distance to the rigid one (L²)", title="Penalty error")

# %%
# The certificate
# ---------------
#
# The bound is for the soft table. That of the penalty is another error, which the right picture
# shows.

check = dvax.verify(problem, jnp.zeros(n), 0.0, 2.0, stiffness[-1])
bound = dvax.bound_error(problem, ends[-1], check.constants)
print(f"assumptions for β = {stiffness[-1]:g}: {check.status}")
print(f"error of the membrane in L²: at most {float(bound.x[-1]):.0e} ({bound.status})")
