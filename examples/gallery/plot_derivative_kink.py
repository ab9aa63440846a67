"""
The derivative at a kink
========================

A point rests exactly where a stop begins to push, u = max(x, 0). Its end at t = 1 has a kink as a
function of its start: the slopes from both sides differ. `jax.grad` returns one of them, that of
the constrained side (u = 0), and `dvax.directional_derivative` returns the one in a given
direction.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
problem = dvax.Problem(
    A=dvax.generators.Zero(),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, 9.0),
    f=lambda t, x, u, args: u - 2.0 * x,
    h=lambda t, x, u, args: x,
)


@jax.jit
def end(x0):
    return dvax.solve(problem, x0, 0.0, 1.0, method=dvax.ETD4RK(), dt=1 / 64).xs[-1]


starts = np.linspace(-0.5, 0.5, 41)
ends = np.array([end(x) for x in starts])
gradient = float(jax.grad(end)(0.0))
away = dvax.directional_derivative(problem, 0.0, 0.0, 1.0, dx0=1.0)

# %%

figure, axes = plt.subplots()
axes.plot(starts, ends, label="x(1) as a function of x(0)")
axes.plot(starts, gradient * starts, "--", color="C7", label=f"jax.grad at 0: {gradient:.4f}")
slope = float(away.dxs[0])
axes.plot(
    starts, slope * starts, ":", color="C1", label=f"directional derivative upwards: {slope:.4f}"
)
axes.set(xlabel="start x(0)", ylabel="end x(1)", title="A kink of the solution map")
axes.legend()
print("closed forms:", f"{np.exp(-1.0):.4f} and {np.exp(-2.0):.4f}")
print("kinks on the way:", [kink.kind for kink in away.kinks])

# %%
# The certificate
# ---------------

check = dvax.verify(problem, 0.0, 0.0, 1.0)
sol = dvax.solve(problem, 0.3, 0.0, 1.0, method=dvax.ETD2RK(), rtol=1e-8)
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions: {check.status}")
print(f"error from x(0) = 0.3 at most {float(bound.x[-1]):.0e} ({bound.status})")
print(f"true error: {abs(float(sol.xs[-1]) - 0.3 * np.exp(-1.0)):.0e}")
