"""
A proved bound of a chaotic trajectory
======================================

A force with limits acts on Lorenz' system. Two solutions that start close to each other are far apart
after some time, so that no constant for all x gives a useful bound. Along the computed trajectory the
bound is close to the true error: it grows where errors grow, and decreases where they decrease.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)


def lorenz(t, x, u, args):
    return jnp.stack(
        [10.0 * (x[1] - x[0]), x[0] * (28.0 - x[2]) - x[1] + u, x[0] * x[1] - 8.0 / 3.0 * x[2]]
    )


problem = dvax.Problem(
    A=dvax.generators.Scalar(0.0),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(-10.0, 10.0),
    f=lorenz,
    h=lambda t, x, u, args: -x[1],  # the force against x₂, as far as its limits allow
    control_space=dvax.spaces.Euclidean(()),
)
x0, ts = jnp.array([1.0, 1.0, 20.0]), np.linspace(0.0, 6.0, 241)
sol = dvax.solve(problem, x0, 0.0, 6.0, ts=ts)
bound = dvax.bound_error(problem, sol)

sharp = dvax.solve(
    problem, x0, 0.0, 6.0, ts=ts, rtol=1e-12, atol=1e-12, method=dvax.ExpRosenbrock()
)
error = np.linalg.norm(np.asarray(sol.xs - sharp.xs), axis=1)

# %%

figure, (above, below) = plt.subplots(2, 1, sharex=True, layout="constrained")
above.plot(ts, sol.xs[:, 0], label="x₁")
above.plot(ts, sol.us, "--", label="force u")
above.set(ylabel="x₁, u", ylim=(-20, 28), title="Lorenz' system with a limited force")
above.legend(loc="upper left", ncols=2)
below.semilogy(ts[1:], bound.x[1:], label=f"bound ({bound.status})")
below.semilogy(ts[1:], error[1:], "--", label="true error")
below.set(xlabel="t", ylabel="error of x")
below.legend(loc="upper left")

# %%
# The certificate
# ---------------

print(f"bound at the end: {float(bound.x[-1]):.1e} ({bound.status})")
print("the bound is above the true error at all times:", bool((error <= bound.x + 1e-11).all()))
print(f"largest ratio after t = 0.1: {float(np.max((bound.x / error)[ts > 0.1])):.0f}")
