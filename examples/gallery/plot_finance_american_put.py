"""
An American put: value, derivatives, implied volatility
=======================================================

An American put may be exercised at any time, so its value V never falls below the payoff 1 − S.
Prices S are multiples of the strike; times are in years. Where exercise is best, V = 1 − S, and
the equation of Black and Scholes holds with a payment u: an obstacle problem. The law
u = max(0, (payoff − V)/ε) approximates it from below. With the payment q of an exercised put in
addition, u = max(0, q + (payoff − V)/ε), it does so from above, and the mean of the two is closer.

With V = g + exp(a s) x and s = ln S, the state x diffuses at a constant rate and vanishes at both
ends of the grid, where g is equal to the payoff and solves the equation without u.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import CubicSpline

import dvax

jax.config.update("jax_enable_x64", True)
low, high, n = -0.4, 1.0, 140  # s = ln S; the strike is on the face between two cells
cell = (high - low) / n
s = low + cell * (jnp.arange(n) + 0.5)
payoff = jnp.maximum(1.0 - jnp.exp(s), 0.0)
space = dvax.spaces.L2(jnp.full(n, cell))


def generator(args):
    return dvax.generators.Elliptic(
        n, high - low, "dirichlet", args["diffusion"], reaction=args["reaction"],
        scheme="differences",
    )  # fmt: skip


problem = dvax.Problem(
    A=generator,
    P=dvax.operators.Scaling(1.0),
    K=dvax.sets.Box(0.0, jnp.inf),
    f=lambda t, x, u, args: u,
    h=lambda t, x, u, args: args["q"] + (args["obstacle"] - x) / args["epsilon"],
    state_space=space,
    control_space=space,
)


def law(rate, volatility, above, epsilon=5e-4):
    """Return args, g and exp(a s) for an interest rate in 1/year and a volatility in 1/√year."""
    half = 0.5 * volatility**2
    a = 0.5 - rate / volatility**2
    c = rate + a**2 * half
    decay = jnp.sqrt(c / half)
    g = jnp.exp(a * (s - low)) * jnp.sinh(decay * (high - s)) / jnp.sinh(decay * (high - low))
    g, scale = (1.0 - np.exp(low)) * g, jnp.exp(a * s)
    args = {"diffusion": half, "reaction": -c, "epsilon": epsilon, "obstacle": (payoff - g) / scale}
    q = jnp.maximum(-generator(args).apply(args["obstacle"]), 0.0)
    return args | {"q": above * q}, g, scale


def solve(args):
    return dvax.solve(
        problem, args["obstacle"], 0.0, 1.0, args, rtol=1e-3, atol=1e-3, method=dvax.ETD2RK(),
        adjoint="forward",
    )  # fmt: skip


def value(rate, volatility):
    """Return the mean of the two laws at the nodes, one year before expiry."""

    def end(above):
        args, g, scale = law(rate, volatility, above)
        return g + scale * solve(args).xs[-1]

    return jnp.mean(jax.lax.map(end, jnp.array([0.0, 1.0])), axis=0)


rate, volatility = 0.05, 0.2
values = jax.jit(value)
derivatives = jax.jit(jax.jacfwd(value, argnums=(0, 1)))
V = values(rate, volatility)
rho, vega = derivatives(rate, volatility)
S = jnp.exp(s)
delta = jnp.gradient(V, cell) / S
for place in (0.9, 1.0, 1.1, 1.2):
    print(
        f"S = {100 * place:.0f}: put on the strike 100 is worth {100 * CubicSpline(S, V)(place):.2f}"
    )

# %%
# Newton's method finds the volatility at which a put at the strike has a given value:

quote, implied = 0.08, volatility
for _ in range(4):
    misfit = CubicSpline(S, values(rate, implied))(1.0) - quote
    implied -= misfit / CubicSpline(S, derivatives(rate, implied)[1])(1.0)
print(f"implied volatility of the quote {quote}: {implied:.3f} per √year")

# %%

figure, (left, right) = plt.subplots(1, 2)
exercised = float(S[V < payoff].max())  # the mean of the two laws is below the payoff there
left.plot(S, payoff, color="C7", linewidth=4, alpha=0.4, label="payoff 1 − S")
left.plot(S, V, label="value V, one year before expiry")
left.axvline(exercised, color="C1", linestyle=":", label=f"exercise below {exercised:.2f}")
left.set(xlim=(0.7, 1.4), ylim=(0.0, 0.35), xlabel="price S / strike", ylabel="V / strike")
left.set(title="Value")
left.legend()
for curve, label in ((delta, "delta, per S"), (vega, "vega, √year"), (rho, "rho, year")):
    right.plot(S, curve, label=label)
right.set(xlim=(0.7, 1.4), xlabel="price S / strike", ylabel="derivative of V / strike")
right.set(title="Derivatives")
right.legend()

# %%
# The certificate
# ---------------
#
# The two laws enclose the value of the obstacle problem on the grid. The bound in L² is that of the
# time integration. The error of the grid is a third one, which is not bounded here.

for above in (0.0, 1.0):
    args, g, scale = law(rate, volatility, above)
    check = dvax.verify(problem, args["obstacle"], 0.0, 1.0, args)
    sol = solve(args)
    bound = dvax.bound_error(problem, sol, check.constants)
    side = "above" if above > 0.0 else "below"
    at_strike = 100 * float(CubicSpline(S, g + scale * sol.xs[-1])(1.0))
    print(f"from {side}: {at_strike:.4f}, assumptions {check.status}")
    print(f"error of x in L²: at most {float(bound.x[-1]):.0e} ({bound.status})")
