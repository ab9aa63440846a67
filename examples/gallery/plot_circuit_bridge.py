"""
A bridge rectifier from a netlist
=================================

Four diodes rectify both half-waves. `dvax.models.Circuit` reads the netlist and writes the law. A
bridge of ideal diodes does not determine how two of them share a current, so that each needs a
small resistance r_on and leak g_leak.
"""

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvax
from dvax.models import Circuit

jax.config.update("jax_enable_x64", True)
netlist = """
V1 a 0 SIN(0 12 50)
R0 a in 5            ; the winding of the transformer
D1 in p
D2 0 p
D3 n in
D4 n 0
C1 p n 100u          ; smoothing
R1 p n 200           ; load
L1 p q 50m           ; filter
R2 q n 100
"""
circuit = Circuit(netlist.strip(), r_on=0.05, g_leak=1e-6)
ts = np.linspace(0.0, 0.05, 1001)
sol = circuit.solve(ts[-1], ts=ts)

# %%

figure, axes = plt.subplots()
axes.plot(
    1e3 * ts, np.abs(12 * np.sin(2 * np.pi * 50 * ts)), color="C7", linestyle="--", label="|source|"
)
axes.plot(1e3 * ts, sol.xs[:, 0], label="capacitor C1")
axes.plot(1e3 * ts, 100 * sol.xs[:, 1], label="100 Ω × current of L1")
axes.set(xlabel="time t [ms]", ylabel="voltage [V]", title="Bridge rectifier")
axes.legend(loc="lower right")
print("states:", circuit.states)

# %%
# The certificate
# ---------------

bound = dvax.bound_error(circuit.problem, sol, circuit.constants)
print(f"in the class: {circuit.fit}")
print(f"constants: {circuit.constants.status_of('gamma', 'L_F')}")
print(f"{int(sol.stats['switchings'])} switchings")
print(f"error of the state: at most {float(np.max(bound.x)):.0e} √J ({bound.status})")
