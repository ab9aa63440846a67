"""
A yielding frame in an earthquake
=================================

A one-storey frame of period 0.5 s and 5 % damping is shaken by a synthetic record: a decaying
pulse of 0.4 g. Its columns yield at half of the force that an elastic frame would need, by a
viscoplastic law. `dvax.models.Frame` states the equations; lengths are in inches.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvax
from dvax.models import Accelerogram, Frame

jax.config.update("jax_enable_x64", True)
t = 0.02 * np.arange(400)
record = Accelerogram(0.02, 0.4 * np.sin(2 * np.pi * t) * np.exp(-0.7 * t))  # in g
frames = {
    "elastic": Frame(record=record, period=0.5, damping=0.05),
    "yielding": Frame(
        record=record, period=0.5, damping=0.05, yield_ratio=0.5, viscosity_ratio=0.005
    ),
}
ts = np.linspace(0.0, t[-1], 800)
runs = {name: frame.solve(ts=ts) for name, frame in frames.items()}

# %%
# The loop on the right is the energy that the columns dissipate.

figure, (left, right) = plt.subplots(1, 2)
for name, sol in runs.items():
    left.plot(ts, sol.xs[:, 0], label=name)
left.set(xlabel="time t [s]", ylabel="displacement d [in]", title="Displacement")
left.legend()
d, plastic = runs["yielding"].xs[:, 0], runs["yielding"].xs[:, 2]
right.plot(d, d - plastic, color="C1", linewidth=1)
right.set(xlabel="displacement d [in]", ylabel="elastic part d − d_p [in]", title="Hysteresis")

# %%
# The certificate
# ---------------
#
# `dvax.PiecewiseLinear` goes from kink to kink and solves each piece to rounding. The constants
# of the model are proved.

frame, sol = frames["yielding"], runs["yielding"]
bound = dvax.bound_error(frame.problem, sol, frame.constants)
print(f"constants: {frame.constants.status_of('gamma', 'L_F')}")
print(f"largest displacement at the saved times: {float(np.abs(d).max()):.4f} in")
print(f"error of the state: at most {float(np.max(bound.x)):.0e} ({bound.status})")
