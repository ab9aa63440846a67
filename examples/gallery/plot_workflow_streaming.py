"""
A long run on disk
==================

With ``save=dvax.ZarrStore(…)`` the saved rows go into a store while the run goes on, and memory
does not grow with their number. Other programs can read the store at any time. Here a valve is
driven by a slowly rising frequency, and 4001 rows are written.
"""

import tempfile

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import xarray

import dvax

jax.config.update("jax_enable_x64", True)
problem = dvax.Problem(
    A=dvax.generators.Scalar(-2.0),
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(-0.5, 0.5),
    f=lambda t, x, u, args: 4.0 * jnp.sin(0.05 * t**2) - 2.0 * u,
    h=lambda t, x, u, args: 3.0 * x,
)
ts = np.linspace(0.0, 60.0, 4_001)
folder = tempfile.mkdtemp()
store = dvax.ZarrStore(f"{folder}/valve.zarr")
end = dvax.solve(
    problem, 0.0, 0.0, 60.0, ts=ts, rtol=1e-5, atol=1e-6, method=dvax.ETD2RK(), save=store
)

# %%

with xarray.open_zarr(store.path) as data:
    print(dict(data.sizes), sorted(data.data_vars))
    figure, (top, bottom) = plt.subplots(2, 1, sharex=True)
    top.plot(data.time, data.x, linewidth=0.8)
    bottom.plot(data.time, data.u, linewidth=0.8, color="C1")
top.set(ylabel="opening x [mm]", title="A valve with a rising frequency")
bottom.set(xlabel="time t [s]", ylabel="reaction u [N]")

# %%
# The certificate
# ---------------
#
# The returned solution has the last row, with the integral of the defect over the whole run.

check = dvax.verify(problem, 0.0, 0.0, 60.0)
bound = dvax.bound_error(problem, end, check.constants)
print(f"assumptions: {check.status}")
print(f"error at the end: at most {float(bound.x[-1]):.0e} mm ({bound.status})")
