"""
Train a neural network inside a law, and prove it well posed
============================================================

Two pads push against a soft wall, whose forces u depend on each other in an unknown way::

    x' = ℓ(t) − 0.5 x − u,        u ∈ x − φ(u) − N_K(u),    K = [0, 1]²

A network φ_θ learns φ from noisy depths x alone, by gradients of whole trajectories. The law has
exactly one response if F(u) = u + φ_θ(u) − x is strongly monotone, with a modulus γ > 0. After each
epoch `dvax.verify` tries to prove this from the code of the network. Matrices whose norms have a
product of 0.9 imply γ ≥ 0.1. The same training without this limit reaches a smaller loss and a law
without γ. Units: mm, s, N; the mobility of the pads is 1 mm/(N s), the stiffness of the wall 1 N/mm.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.optimize import minimize

import dvax

jax.config.update("jax_enable_x64", True)
rng = np.random.default_rng(1)
noise, width, lipschitz, end = 0.05, 12, 0.9, 6.0
ts = np.linspace(0.0, end, 21)[1:]


def wall(phi):
    return dvax.Problem(
        A=dvax.generators.Scalar(-0.5),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 1.0),
        f=lambda t, x, u, args: args[0](t) - u,
        h=lambda t, x, u, args: x - phi(args[1], u),
    )


def load(values):
    return dvax.signals.Table(np.linspace(0.0, end, 13), values)


def trajectory(problem, values, theta=None):
    return dvax.solve(
        problem, jnp.zeros(2), 0.0, end, (load(values), theta), ts, dt=0.05, method=dvax.ETD2RK()
    ).xs


# %%
# The training data: two loads, from a law that softens, and in which the forces turn each other. The
# third load is for later.

unknown = wall(lambda theta, u: -0.8 * jnp.tanh(u - 0.5) + 0.3 * jnp.stack([u[1], -u[0]]))
loads = jnp.asarray(rng.uniform(-0.5, 2.0, (3, 13, 2)))
true = [trajectory(unknown, values) for values in loads]
data = jnp.stack(true[:2]) + noise * rng.normal(size=(2, 20, 2))

# %%
# The network has one layer of tanh. ‖W₂‖‖W₁‖ bounds its Lipschitz constant. With limit = 1 the
# matrices are divided by their norms where these are too large, with limit = ∞ they are not.


def network(theta, u):
    W1, b, W2 = theta
    return W2 @ jnp.tanh(W1 @ u + b)


def limited(theta, limit):
    W1, b, W2 = theta
    norm = lambda W: jnp.linalg.norm(W, 2)  # noqa: E731
    W1 = W1 / jnp.maximum(1.0, norm(W1) / limit)
    return W1, b, W2 / jnp.maximum(1.0, norm(W2) / (lipschitz * limit))


model = wall(network)
start, unravel = ravel_pytree(
    (
        0.5 * rng.normal(size=(width, 2)),
        0.3 * rng.normal(size=width),
        0.3 * rng.normal(size=(2, width)),
    )
)


@jax.jit
@jax.value_and_grad
def loss(weights, limit):
    theta = limited(unravel(weights), limit)
    xs = jax.vmap(lambda values: trajectory(model, values, theta))(loads[:2])
    return jnp.mean((xs - data) ** 2) / noise**2


def train(limit):
    weights, history = start, []
    for _ in range(5):
        found = minimize(
            lambda w: [np.asarray(v) for v in loss(w, limit)], weights, jac=True, method="L-BFGS-B",
            options={"maxiter": 12},
        )  # fmt: skip
        weights = jnp.asarray(found.x)
        theta = limited(unravel(weights), limit)
        check = dvax.verify(model, jnp.zeros(2), 0.0, end, (load(loads[0]), theta))
        history.append((found.fun, check))
    return theta, history


bounded, with_limit = train(1.0)
free, without = train(jnp.inf)


def modulus(check):
    """γ where it is proved, else None."""
    return float(check.constants.gamma) if check.status == "proved" else None


for name, history in (("limited", with_limit), ("free", without)):
    for epoch, (value, check) in enumerate(history, 1):
        row = check["ass:strong_pseudomono"]
        gamma = "" if modulus(check) is None else f", γ = {modulus(check):.3f}"
        print(f"{name:8} epoch {epoch}: loss {value:.3f}, {row.status}{gamma}")

# %%
# Left: the modulus after each epoch. A cross is an epoch whose law has no proof. Right: the prediction
# for the third load, which neither training has used.

epochs = np.arange(1, 6)
figure, (left, right) = plt.subplots(1, 2, layout="constrained")
for history, color, marker, name in (
    (with_limit, "C0", "o", "norms limited"),
    (without, "C1", "s", "not limited"),
):
    gammas = np.array([modulus(check) or np.nan for _, check in history])
    if np.any(gammas > 0):
        left.plot(epochs, gammas, marker=marker, color=color, label=name)
    missing = epochs[np.isnan(gammas)]
    if missing.size:
        left.plot(missing, 0 * missing, "x", color=color, markersize=9, label=f"{name}: no proof")
left.axhline(0.2, color="0.4", linestyle="--", label="unknown law")
left.axhline(1.0 - lipschitz, color="0.4", linestyle=":", label="1 − product of norms")
left.set(xlabel="epoch", ylabel="proved γ [1]", title="Well posed?", xticks=epochs)
left.set_ylim(-0.03, 0.42)
left.legend(fontsize="x-small", loc="upper right")


def prediction(values):
    args = load(values), bounded
    return dvax.solve(model, jnp.zeros(2), 0.0, end, args, ts, rtol=1e-8, atol=1e-10)


sol = prediction(loads[2])
for k, color in enumerate(("C0", "C1")):
    right.plot(ts, true[2][:, k], color=color, label=f"pad {k + 1}, unknown law")
    right.plot(ts, sol.xs[:, k], "o", color="0.2", markersize=4,
               label="predicted" if k else None)  # fmt: skip
right.set(xlabel="time t [s]", ylabel="depth x [mm]", title="Unseen load")
right.legend(fontsize="x-small")

# %%
# The training data and the loss. The loss shows nothing of what the left panel above shows.

figure, (left, right) = plt.subplots(1, 2, layout="constrained")
fitted = prediction(loads[0]).xs
for k, color in enumerate(("C0", "C1")):
    left.plot(ts, data[0, :, k], "o", color=color, markersize=4, label=f"pad {k + 1}, measured")
    left.plot(ts, fitted[:, k], color=color, label=f"pad {k + 1}, fitted")
left.set(xlabel="time t [s]", ylabel="depth x [mm]", title="One of two records")
left.legend(fontsize="x-small")
right.plot(epochs, [v for v, _ in with_limit], "o-", color="C0", label="norms limited")
right.plot(epochs, [v for v, _ in without], "s--", color="C1", label="not limited")
right.set(xlabel="epoch", ylabel="loss, mean of (Δx/noise)² [1]", title="Training", xticks=epochs)
right.legend(fontsize="x-small")

# %%
# The certificate
# ---------------
#
# The bound is for the learned law: the distance of the computed trajectory from the exact one of the
# same network. The distance to the unknown law is a difference of two computations.

check = dvax.verify(model, jnp.zeros(2), 0.0, end, (load(loads[2]), bounded))
bound = dvax.bound_error(model, sol, check.constants)
distance = float(jnp.max(jnp.linalg.norm(sol.xs - true[2], axis=1)))
print(f"assumptions: {check.status}; γ = {float(check.constants.gamma):.3f}")
print(f"error of the prediction: at most {float(bound.x.max()):.1e} mm ({bound.status})")
print(f"distance to the trajectory of the unknown law: {distance:.3f} mm")
last = without[-1][1]["ass:strong_pseudomono"]
print(f"without limits: {last.status}: {last.why}")
