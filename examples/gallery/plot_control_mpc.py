"""
Model predictive control of a cart
==================================

A cart of 1 kg on a spring of 1 N/m has to go back to 0, with a force of at most 1 N. The
controller plans eight moves ahead and applies the first, at every time: a quadratic programme in
the loop. `dvax.models.LinearMPC` states it as a law.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax
from dvax.models import LinearMPC

jax.config.update("jax_enable_x64", True)
mpc = LinearMPC(
    A=[[0.0, 1.0], [-1.0, -0.5]],
    B=[[0.0], [1.0]],
    Q=np.diag([2.0, 1.0]),
    R=[[1.0]],
    horizon=8,
    step=0.25,
    lower=-1.0,
    upper=1.0,
)
x0, ts = jnp.array([3.0, 0.0]), np.linspace(0.0, 10.0, 201)
sol = dvax.solve(mpc.problem, x0, 0.0, 10.0, ts=ts, rtol=1e-6, method=dvax.ETD4RK())

# %%

figure, (top, bottom) = plt.subplots(2, 1, sharex=True)
top.plot(ts, sol.xs[:, 0], label="place [m]")
top.plot(ts, sol.xs[:, 1], label="speed [m/s]")
top.set(ylabel="state", title="A cart under predictive control")
top.legend()
bottom.plot(ts, sol.us[:, 0], color="C3")
bottom.axhline(1.0, color="C7", linestyle=":")
bottom.axhline(-1.0, color="C7", linestyle=":")
bottom.set(xlabel="time t [s]", ylabel="force [N]")

# %%
# The certificate
# ---------------
#
# `mpc.lipschitz` are three proved bounds on the gain of the controller. A norm in which the
# closed loop contracts is found by a semidefinite programme, and its rate is computed again from
# that norm.

check = dvax.verify(mpc.problem, x0, 0.0, 10.0, energy=True)
bound = dvax.bound_error(mpc.problem, sol, check.constants)
print("gain of the controller, three bounds:", [f"{v:.2f}" for v in mpc.lipschitz])
print(f"assumptions: {check.status}")
print(f"the closed loop decays with {-float(check.constants.energy[1]):.3f} per second")
print(f"error of the state: at most {float(bound.x.max()):.0e} ({bound.status})")
