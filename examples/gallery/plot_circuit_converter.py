"""
A switched converter that starts from rest
==========================================

A transistor connects an inductor to 12 V for 4 µs of every 10 µs. In the rest of the period a diode
carries the current. While the capacitor charges, the current never stops. Later it does, because
the load of 100 Ω is light: the diode blocks before the period ends (discontinuous conduction), and the
output is higher than 0.4 · 12 V. The transistor conducts in one direction only. The netlist therefore
has a source of ±12 V with a diode in its place.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvax
from dvax.models import Circuit

jax.config.update("jax_enable_x64", True)
netlist = """
V1 in 0 PULSE(-12 12 0 0 0 4u 10u)
D1 in sw R=0.1 G=1u    ; the transistor
D2 0 sw R=0.1 G=1u     ; the diode that takes over
L1 sw out 100u
C1 out 0 10u
R1 out 0 100
"""
circuit = Circuit(netlist.strip())
period, periods = 1e-5, 100
ts = np.linspace(0.0, periods * period, 50 * periods + 1)
sol = circuit.solve(ts[-1], ts=ts, max_steps=100_000)

# %%

voltage, current = np.asarray(sol.xs).T
figure, (top, bottom) = plt.subplots(2, 1)
top.plot(1e3 * ts, voltage, label="output [V]")
top.plot(1e3 * ts, current, label="current of L1 [A]")
top.set(
    xlabel="time t [ms]", ylabel="voltage, current", title="A converter of 12 V at a light load"
)
top.legend(loc="upper right")
last = ts >= ts[-1] - 3.0 * period
bottom.plot(1e6 * (ts[last] - ts[last][0]), 1e3 * current[last], color="C1")
bottom.set(xlabel="time in the last three periods [µs]", ylabel="current of L1 [mA]")
print(f"{periods} periods, {int(sol.stats['switchings'])} switchings besides those of the source")
print(f"output at the end: {voltage[-1]:.6f} V")

# %%
# The certificate
# ---------------

bound = dvax.bound_error(circuit.problem, sol, circuit.constants)
volts = float(np.max(bound.x)) / np.sqrt(float(circuit.storage[0]))
print(f"in the class: {circuit.fit}")
print(f"constants: {circuit.constants.status_of('gamma', 'L_F')}")
print(f"error of the output: at most {volts:.0e} V ({bound.status})")
