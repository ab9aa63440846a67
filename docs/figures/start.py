"""The picture of docs/start.md: the controlled mass, as `Solution.plot` draws it."""

from pathlib import Path

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvax


def draw(path: Path) -> None:
    problem = dvax.Problem(
        A=dvax.generators.Dense(jnp.array([[0.0, 1.0], [-40.0, -1.0]])),
        P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(-5.0, 5.0),
        f=lambda t, x, u, gain: jnp.stack([0.0 * u, u]),
        h=lambda t, x, u, gain: gain * (0.1 - x[0]) - 10.0 * x[1] + 4.0,
        control_space=dvax.spaces.Euclidean(()),
    )
    ts = np.linspace(0.0, 1.0, 201)
    sol = dvax.solve(problem, jnp.zeros(2), 0.0, 1.0, args=100.0, ts=ts, rtol=1e-8)
    figure = sol.plot({"position": "m", "speed": "m/s"}, {"force": "N"}, time_unit="s")
    figure.savefig(path)
    plt.close(figure)
