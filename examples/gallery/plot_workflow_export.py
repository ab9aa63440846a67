"""
Run it where its code is not
============================

`dvax.export` compiles a solve into one file. Another process loads it without the functions of
the problem, calls it with other numbers, and differentiates it.
"""

import tempfile

import jax
import matplotlib.pyplot as plt
import numpy as np

import dvax

jax.config.update("jax_enable_x64", True)
problem = dvax.Problem(
    A=dvax.generators.Scalar(-1.0),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, 0.5),
    f=lambda t, x, u, args: args["load"] - 0.5 * x - u,
    h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
)
program = dvax.export(problem, -1.0, 0.0, 2.0, {"load": 3.0}, derivatives=1, rtol=1e-8)
path = f"{tempfile.mkdtemp()}/point.dvax"
program.save(path)

# %%
# In another process:

run = dvax.load_exported(path)
loads = np.linspace(1.0, 4.0, 25)
depth = jax.jit(lambda load: run(args={"load": load}).xs[0])
ends = np.array([depth(load) for load in loads])
slopes = np.array([jax.grad(depth)(load) for load in loads])

figure, (left, right) = plt.subplots(1, 2)
left.plot(loads, ends)
left.set(xlabel="load [N]", ylabel="depth at t = 2 [mm]", title="Result of the program")
right.plot(loads, slopes, color="C1")
right.set(xlabel="load [N]", ylabel="slope [mm/N]", title="Its derivative")

# %%
# The certificate
# ---------------

check = dvax.verify(problem, -1.0, 0.0, 2.0, {"load": 3.0})
sol = dvax.solve(problem, -1.0, 0.0, 2.0, {"load": 3.0}, rtol=1e-8, method=dvax.ETD2RK())
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions: {check.status}")
print(f"error of the example: at most {float(bound.x[-1]):.0e} mm ({bound.status})")
print(f"program and example differ by {abs(float(run().xs[0]) - float(sol.xs[-1])):.0e}")
