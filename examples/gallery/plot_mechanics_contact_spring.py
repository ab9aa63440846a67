"""
A mass on a spring meets a soft stop
====================================

A mass of 1 kg hangs on a spring of 400 N/m and is driven by a periodic force. At 10 mm there is a
rubber stop. It pushes back with 800 N/m, and yields at 8 N::

    m x'' = −k x − c x' + 6 sin(15 t) − u,        u = clip(800 (x − 0.01), 0, 8)      [N]

The reaction u is the projection of 800 (x − 0.01) onto K = [0, 8]. The state is (x, v) in m and
m/s. Its norm is the energy norm, ‖(x, v)‖² = k x² + m v², so that a bound on the error is the
root of an energy.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
m, k, c = 1.0, 400.0, 4.0

problem = dvax.Problem(
    A=dvax.generators.Dense(jnp.array([[0.0, 1.0], [-k / m, -c / m]])),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, 8.0),
    f=lambda t, x, u, args: jnp.stack([0.0 * u, (6.0 * jnp.sin(15.0 * t) - u) / m]),
    h=lambda t, x, u, args: 800.0 * (x[0] - 0.01),
    state_space=dvax.spaces.L2(jnp.array([k, m])),
    control_space=dvax.spaces.Euclidean(()),
)
x0, ts = jnp.array([0.0, 0.0]), np.linspace(0.0, 2.0, 401)
sol = dvax.solve(problem, x0, 0.0, 2.0, ts=ts, rtol=1e-8, atol=1e-10)

# %%
# The grey bands are the times in which the stop pushes.

figure, (top, bottom) = plt.subplots(2, 1, sharex=True)
top.plot(ts, 1e3 * sol.xs[:, 0])
top.axhline(10.0, color="C7", linestyle="--", label="stop")
top.set(ylabel="position x [mm]", title="A driven mass meets a soft stop")
top.legend(loc="lower right")
bottom.plot(ts, sol.us, color="C1")
bottom.axhline(8.0, color="C7", linestyle=":", label="yield force")
bottom.set(xlabel="time t [s]", ylabel="reaction u [N]")
bottom.legend(loc="upper right")
for axes in (top, bottom):
    axes.fill_between(
        ts, 0, 1, where=np.asarray(sol.us) > 0, color="0.9", transform=axes.get_xaxis_transform()
    )

# %%
# The certificate
# ---------------
#
# The assumptions are proved from the code of f and h. The defect of the fifth-order method is
# sampled and not enclosed, so that the bound on the error is estimated.

check = dvax.verify(problem, x0, 0.0, 2.0)
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions: {check.status}")
print(f"method: {sol.stats['method'].split(':')[0]}, {int(sol.stats['steps'])} steps")
print(
    f"growth rate of the theory: {float(check.constants.growth_rate):.0f} per second, "
    f"with signs: {float(check.constants.one_sided):.0f} per second"
)
for k in (50, 100):
    print(f"error of the state at {ts[k]:g} s: at most {float(bound.x[k]):.0e} √J ({bound.status})")
