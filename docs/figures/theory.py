"""The pictures of the theory pages: each from a solution or a formula of dvax."""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from docs.extensions.gallery import STYLE

import dvax


def normal_cones(path: Path) -> None:
    """A polyhedron, its normal cone at a corner, and points with their projections."""
    corners = np.array([[0.0, 0.0], [2.2, 0.0], [1.8, 1.2], [0.4, 1.5]])
    K = dvax.sets.Polyhedron(
        G=jnp.array([[0.0, -1.0], [1.2, 0.4], [0.3, 1.4], [-1.5, 0.4]]),
        d=jnp.array([0.0, 2.64, 2.22, 0.0]),
    )
    plane = dvax.spaces.Euclidean(2)
    figure, axes = plt.subplots(figsize=(5.2, 3.6))
    axes.fill(*corners.T, facecolor="#dce6f0", edgecolor="#0072B2")
    axes.text(1.0, 0.55, "K", fontsize=14)
    for normal in (np.array([1.2, 0.4]), np.array([0.3, 1.4])):
        end = corners[2] + 0.9 * normal / np.linalg.norm(normal)
        axes.plot(*np.stack([corners[2], end]).T, color="#D55E00")
    cone = [corners[2], corners[2] + [0.85, 0.285], corners[2] + [0.195, 0.88]]
    axes.fill(*np.array(cone).T, color="#D55E00", alpha=0.2)
    axes.text(2.2, 1.75, "y + N_K(y)", color="#D55E00")
    for z in ([2.3, 1.7], [1.0, 2.0], [-0.5, 0.8], [1.0, -0.6]):
        y = np.asarray(K.project(jnp.array(z), plane))
        axes.annotate("", y, z, arrowprops={"arrowstyle": "-|>", "color": "#222222"})
        axes.plot(*z, "o", color="#222222", markersize=4)
    axes.set(xlim=(-0.9, 3.2), ylim=(-0.9, 2.4), aspect="equal")
    axes.axis("off")
    figure.savefig(path.with_name("theory-preliminaries.svg"))


def contact_problem():
    return dvax.models.Contact(
        alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0, kappa0=0.5, g=1.0, ell=3.0
    )


def response(path: Path) -> None:
    """The response u_x as a function of x, inside the wedge of its Lipschitz constant."""
    model = contact_problem()
    x = np.linspace(-1.0, 1.5, 201)
    u = np.array([float(model.problem.response(0.0, v)) for v in x[::8]])
    figure, axes = plt.subplots(figsize=(5.4, 3.2))
    axes.plot(x[::8], u, label="u_x")
    slope = float(model.constants.L)
    axes.fill_between(x, 0.2 - slope * abs(x - 0.3), 0.2 + slope * abs(x - 0.3), alpha=0.15,
                      label="Lipschitz constant L")  # fmt: skip
    axes.set(xlabel="state x", ylabel="response u", ylim=(-0.2, 0.8))
    axes.legend()
    figure.savefig(path.with_name("theory-system.svg"))


def picard(path: Path) -> None:
    """The first iterates of the Picard map of the contact law."""
    ts = np.linspace(0.0, 2.0, 401)
    law = lambda x: np.clip((1.0 - 2.0 * x) / 2.0, 0.0, 0.5)  # noqa: E731
    rate = lambda x: 3.0 - 0.5 * x - law(x)  # noqa: E731
    x, h = -np.exp(-ts), ts[1] - ts[0]
    figure, axes = plt.subplots(figsize=(5.4, 3.2))
    axes.plot(ts, x, color="0.7", label="iterate 0")
    for k in range(1, 5):
        kernel = np.exp(ts) * rate(x)
        total = np.concatenate([[0.0], np.cumsum((kernel[1:] + kernel[:-1]) * h / 2)])
        x = -np.exp(-ts) + np.exp(-ts) * total
        axes.plot(ts, x, linewidth=1 + 0.3 * k, label=f"iterate {k}")
    axes.set(xlabel="time t", ylabel="state x")
    axes.legend()
    figure.savefig(path.with_name("theory-existence.svg"))


def decay(path: Path) -> None:
    """Two trajectories, their distance, and the two proved bounds."""
    model = contact_problem()
    ts = np.linspace(0.0, 3.0, 61)
    runs = [dvax.solve(model.problem, x0, 0.0, 3.0, ts=ts, rtol=1e-8) for x0 in (-1.0, 1.0)]
    c = model.constants
    figure, axes = plt.subplots(figsize=(5.4, 3.2))
    axes.semilogy(
        ts, np.abs(np.asarray(runs[0].xs - runs[1].xs)), label="distance of two solutions"
    )
    for rate, name, style in (
        (float(c.growth_rate), "paper: M e^{(ω + M L̃)t}", "--"),
        (float(c.one_sided), "with signs: e^{μt}", ":"),
    ):
        axes.semilogy(ts, 2.0 * np.exp(rate * ts), style, label=name)
    axes.set(xlabel="time t", ylabel="‖x₁ − x₂‖")
    axes.legend()
    figure.savefig(path.with_name("theory-stability.svg"))


def parameters(path: Path) -> None:
    """The effect of a change of the load: actual, predicted and certified."""
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, ell: ell - 0.5 * x - u, h=lambda t, x, u, ell: 1.0 - 2.0 * x - u,
    )  # fmt: skip
    bounds = dvax.parameter_bounds(problem, 2.9, 3.1, t1=2.0)
    change = dvax.sensitivity.change(problem, -1.0, 0.0, 2.0, 3.0, bounds, dargs=0.1)
    figure, axes = plt.subplots(figsize=(5.4, 3.2))
    axes.plot(change.ts, change.x.actual, linewidth=3, alpha=0.5, label="actual")
    axes.plot(change.ts, change.x.predicted, "--", label="predicted by the derivative")
    axes.plot(change.ts, change.x.certified, label=f"certified ({change.status})")
    axes.set(xlabel="time t", ylabel="‖Δx‖ for Δℓ = 0.1")
    axes.legend()
    figure.savefig(path.with_name("theory-sensitivity.svg"))


def regimes(path: Path) -> None:
    """The pressure law of the contact example with its three regimes."""
    q = np.linspace(-0.6, 1.8, 200)
    figure, axes = plt.subplots(figsize=(5.4, 3.2))
    axes.plot(q, np.clip(q / 2.0, 0.0, 0.5))
    for x, text in ((-0.3, "unloaded"), (0.5, "active"), (1.4, "saturated")):
        axes.text(x, 0.56, text, ha="center")
    for x in (0.0, 1.0):
        axes.axvline(x, color="#777777", linestyle="--", linewidth=1)
    axes.set(xlabel="drive q(t, x) = g − b_x x", ylabel="pressure p", ylim=(-0.05, 0.65))
    figure.savefig(path.with_name("theory-contact.svg"))


def draw(path: Path) -> None:
    jax.config.update("jax_enable_x64", True)
    with plt.rc_context({**STYLE, "svg.fonttype": "path", "svg.hashsalt": "dvax"}):
        for picture in (normal_cones, response, picard, decay, parameters, regimes):
            picture(path)
            plt.close("all")
    path.touch()
