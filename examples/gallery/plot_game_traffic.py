"""
Traffic finds its equilibrium
=============================

Six thousand drivers go from 1 to 2. Two routes are long, and a shortcut joins them (Braess'
network). Every day some drivers change to a faster route, and after two weeks no one gains by a
change: Wardrop's equilibrium. The shortcut makes all trips slower: 92 minutes instead of 83.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvax
from dvax.models.traffic import Network, Traffic, Trips

jax.config.update("jax_enable_x64", True)


links = [
    (1, 3, 1e-8, 1e9),
    (1, 4, 50.0, 0.02),
    (3, 2, 50.0, 0.02),
    (3, 4, 10.0, 0.1),
    (4, 2, 1e-8, 1e9),
]
tail, head, time, slope = (list(column) for column in zip(*links, strict=True))
network = Network(
    zones=2,
    nodes=4,
    first_thru_node=1,
    init_node=tail,
    term_node=head,
    capacity=[1.0] * 5,
    length=[0.0] * 5,
    free_flow_time=time,
    b=slope,
    power=[1.0] * 5,
)
trips = Trips(zones=2, origin=[1], destination=[2], flow=[6.0])
model = Traffic(network, trips, rho=1.0)
ts = np.linspace(0.0, 20.0, 41)
sol = dvax.solve(
    model.problem,
    model.all_or_nothing(),
    0.0,
    20.0,
    ts=ts,
    dt=0.5,
    vi_solver=model.vi_solver,
    constants=model.constants,
)

# %%
# A link of flow v takes t₀ (1 + b v) minutes.

flows = np.array([model.link_flows(x) for x in sol.xs])
minutes = network.free_flow_time * (1.0 + network.b * flows)
figure, (left, right) = plt.subplots(1, 2)
left.plot(ts, sol.xs, label=[f"path {k + 1}" for k in range(sol.xs.shape[1])])
left.set(xlabel="day", ylabel="drivers [1000]", title="Drivers on each path")
left.legend()
right.plot(ts, np.sum(flows * minutes, axis=1) / 6.0, label="mean")
right.axhline(92.0, color="C7", linestyle="--", label="equilibrium")
right.axhline(83.0, color="C7", linestyle=":", label="without the shortcut")
right.set(xlabel="day", ylabel="travel time [min]", title="Braess' paradox")
right.legend()

# %%
# The certificate
# ---------------

bound = dvax.bound_error(model.problem, sol, model.constants)
print(f"in the class: {model.fit.split(':')[0]}")
print(f"constants: {model.constants.status_of('gamma', 'L_F')}")
drivers = 1e3 * float(bound.x[-1])
print(f"error of the flows on the last day: at most {drivers:.2g} drivers ({bound.status})")
