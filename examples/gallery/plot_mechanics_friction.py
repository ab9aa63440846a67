"""
Sliding and sticking on a shaking table
=======================================

A box of 2 kg stands on a table that shakes with the speed 0.6 sin(2π t) m/s. Friction drags the
box along, with at most 4 N. Coulomb's law has a jump at zero slip and is outside the class of
dvax. A contact with the shear stiffness of real surfaces is inside: the friction force grows with
the slip speed over ε = 1 mm/s before it saturates.

::

    m v' = u,        u = clip((w(t) − v) F/ε, −F, F)      [N]
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
mass, limit, eps = 2.0, 4.0, 1e-3


def table(t):
    return 0.6 * jnp.sin(2 * jnp.pi * t)


problem = dvax.Problem(
    A=dvax.generators.Zero(),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(-limit, limit),
    f=lambda t, v, u, args: u / mass,
    h=lambda t, v, u, args: (table(t) - v) * limit / eps,
)
ts = np.linspace(0.0, 3.0, 601)
sol = dvax.solve(problem, 0.0, 0.0, 3.0, ts=ts, rtol=1e-8, atol=1e-8)

# %%
# While the box sticks, both speeds agree; while it slides, it accelerates with 2 m/s².

figure, (top, bottom) = plt.subplots(2, 1, sharex=True)
top.plot(ts, table(ts), color="C7", linestyle="--", label="table")
top.plot(ts, sol.xs, label="box")
top.set(ylabel="speed [m/s]", title="A box on a shaking table")
top.legend(loc="upper right")
bottom.plot(ts, sol.us, color="C1")
bottom.set(xlabel="time t [s]", ylabel="friction u [N]")

# %%
# The certificate
# ---------------
#
# The speed of the box follows a monotone law, so two motions never separate: the rate with signs
# is not positive, although the Lipschitz constant F/(mε) is 2000 per second.

check = dvax.verify(problem, 0.0, 0.0, 3.0)
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions: {check.status}")
print(f"method: {sol.stats['method'].split(':')[0]}, {int(sol.stats['steps'])} steps")
print(
    f"rate of the theory: {float(check.constants.growth_rate):.0f} per second, "
    f"with signs: {float(check.constants.one_sided) + 0.0:.0f}"
)
print(f"error of the speed at the end: at most {float(bound.x[-1]):.0e} m/s ({bound.status})")
