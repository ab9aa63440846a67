"""The picture of the README: the contact point of its example, its kinks, and its error.

    python -m docs.figures.readme

writes docs/_static/readme.png, which is committed.
"""

from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from docs.extensions.gallery import STYLE

import dvax


def draw(path: Path) -> None:
    jax.config.update("jax_enable_x64", True)
    problem = dvax.Problem(
        A=dvax.generators.Scalar(-1.0),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.5),
        f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
        h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    )
    t1 = np.log(8 / 5) / 1.5
    t2 = t1 + 2 * np.log(10 / 9)
    bands = ((0.0, t1, "#f6d5c9"), (t1, t2, "#fdf0c8"), (t2, 1.0, "#d7ecd9"))

    def exact(t):
        last = 2 - 1.5 * np.exp(-1.5 * (t - t2))
        middle = 5 - 5 * np.exp(-(t - t1) / 2)
        return np.where(t < t1, 5 / 3 - 8 / 3 * np.exp(-1.5 * t), np.where(t < t2, middle, last))

    ts = np.linspace(0.0, 1.0, 201)
    sol = dvax.solve(problem, -1.0, 0.0, 1.0, ts=ts, rtol=1e-6, atol=1e-6, method=dvax.ETD2RK())
    bound = dvax.bound_error(problem, sol, dvax.verify(problem, -1.0, 0.0, 1.0).constants)
    errors = np.maximum(np.abs(np.asarray(sol.xs) - exact(ts))[1:], 1e-12)
    with plt.rc_context({**STYLE, "font.size": 9}):
        figure, (state, law, error) = plt.subplots(1, 3, figsize=(10.0, 2.7))
        for axes in (state, law):
            for start, end, shade in bands:
                axes.axvspan(start, end, color=shade, linewidth=0)
        state.plot(ts, sol.xs)
        state.plot([t1, t2], exact(np.array([t1, t2])), "o", color="#222222", markersize=5)
        state.set(title="The state, and its kinks", xlabel="time t", ylabel="x")
        law.plot(ts, sol.us, color="C1")
        law.set(title="The law: u = clip(1 − 2x − u, 0, ½)", xlabel="time t", ylabel="u")
        for place, name in ((t1 / 2, "at its limit"), (0.398, "active"), (0.77, "free")):
            law.text(place, 0.03, name, ha="center")
        error.semilogy(ts[1:], np.asarray(bound.x)[1:], label=f"bound ({bound.status})")
        error.semilogy(ts[1:], errors, label="true error")
        error.set(title="The error, and its bound", xlabel="time t", ylabel="‖x_h − x‖")
        error.legend(loc="lower right")
        figure.savefig(path, dpi=120)
        plt.close(figure)


if __name__ == "__main__":
    draw(Path(__file__).parents[1] / "_static" / "readme.png")
