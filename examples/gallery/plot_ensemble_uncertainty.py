"""
A thousand springs: uncertainty in one call
===========================================

A point is pressed onto a compliant surface. Its stiffness and the load are known to 10 %.
`dvax.ensemble` solves the problem for a thousand pairs in one compiled loop and returns mean,
deviation and quantiles.
"""

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
    h=lambda t, x, u, args: args["stiffness"] * (0.5 - x),
)
random, ts = np.random.default_rng(0), np.linspace(0.0, 2.0, 41)
args = {"load": random.normal(3.0, 0.3, 1000), "stiffness": random.normal(1.0, 0.1, 1000)}
found = dvax.ensemble(problem, -1.0, 0.0, 2.0, args, ts)

# %%

low, middle, high = (np.asarray(found.quantile(q)) for q in (0.05, 0.5, 0.95))
figure, (left, right) = plt.subplots(1, 2)
left.plot(ts, np.asarray(found.values[:25]).T, color="C0", alpha=0.15, linewidth=1)
left.fill_between(ts, low, high, alpha=0.3, label="90 % of the members")
left.plot(ts, middle, label="median", color="C1")
left.set(xlabel="time t [s]", ylabel="depth x [mm]", title="1000 members")
left.legend(loc="lower right")
right.hist(np.asarray(found.values[:, -1]), bins=30)
right.set(xlabel="depth at t = 2 [mm]", ylabel="members", title="The end")
print(f"{int(found.failed.sum())} members failed; mean {float(found.mean[-1]):.3f} mm")

# %%
# The certificate
# ---------------
#
# The assumptions are checked at the mean parameters, and a bound is computed for this member.

mean = {"load": 3.0, "stiffness": 1.0}
check = dvax.verify(problem, -1.0, 0.0, 2.0, mean)
sol = dvax.solve(problem, -1.0, 0.0, 2.0, mean, method=dvax.ETD2RK(), rtol=1e-7)
bound = dvax.bound_error(problem, sol, check.constants)
print(f"assumptions: {check.status}; error at most {float(bound.x[-1]):.0e} mm ({bound.status})")
