"""
Fit a stiffness and a yield force by gradients
==============================================

A press was measured at 40 times with 2 % noise. Its stop has a stiffness k and yields at a force
F. A Gauss–Newton iteration with the Jacobian of the whole solution, through all kinks, finds both
numbers.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
problem = dvax.Problem(
    A=dvax.generators.Scalar(-0.3),
    P=dvax.operators.Scaling(1.0),
    K=lambda t, p: dvax.sets.Box(0.0, p[1]),
    f=lambda t, x, u, p: 2.0 * jnp.sin(t) - u,
    h=lambda t, x, u, p: p[0] * (x - 0.5),
)
ts = np.linspace(0.25, 10.0, 40)


@jax.jit
def depth(p):
    return dvax.solve(
        problem, 0.0, 0.0, 10.0, p, ts, method=dvax.DormandPrince(), adjoint="forward"
    ).xs


truth = jnp.array([4.0, 1.2])
data = np.asarray(depth(truth)) * (1 + 0.02 * np.random.default_rng(1).normal(size=40))
slopes = jax.jit(jax.jacfwd(depth))
p, history = jnp.array([1.0, 0.5]), []
for _ in range(8):
    history.append(np.asarray(p))
    p = p + jnp.linalg.lstsq(slopes(p), data - depth(p))[0]
print(f"k = {float(p[0]):.3f} N/mm (true 4), F = {float(p[1]):.3f} N (true 1.2)")

# %%

history = np.array(history)
figure, (left, right) = plt.subplots(1, 2)
left.plot(ts, data, "o", markersize=3, color="C7", label="measured")
left.plot(ts, depth(history[0]), "--", label="first guess")
left.plot(ts, depth(p), label="fit")
left.set(xlabel="time t [s]", ylabel="depth x [mm]", title="The fit")
left.legend()
right.plot(history[:, 0], "o-", label="k [N/mm]")
right.plot(history[:, 1], "s-", label="F [N]")
right.set(xlabel="iteration", title="Gauss–Newton")
right.legend()

# %%
# The certificate
# ---------------

check = dvax.verify(problem, 0.0, 0.0, 10.0, p)
sol = dvax.solve(problem, 0.0, 0.0, 10.0, p, method=dvax.ETD2RK(), rtol=1e-6)
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions: {check.status}")
print(f"error of the fitted run at most {float(bound.x[-1]):.0e} mm ({bound.status})")
