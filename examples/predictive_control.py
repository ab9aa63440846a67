"""Three masses between two walls, controlled by continuous-time model predictive control.

The program proves the decay of the closed loop, solves it, and draws positions, input and decay. The
page docs/models/mpc.md explains the model.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import dvax
from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.models import LinearMPC

jax.config.update("jax_enable_x64", True)
FOLDER = Path(__file__).parent


def main(folder: Path = FOLDER) -> dict[str, float]:
    """Draw the picture into `folder`, and return the numbers that the program prints."""
    springs = 2 * np.eye(3) - np.eye(3, k=1) - np.eye(3, k=-1)
    mpc = LinearMPC(
        A=np.block([[np.zeros((3, 3)), np.eye(3)], [-springs, -0.5 * np.eye(3)]]),
        B=np.eye(6)[:, [3]], Q=np.eye(6), R=[[0.5]], horizon=12, step=0.25, lower=-0.5, upper=0.5,
    )  # fmt: skip
    constants = dvax.verify(mpc.problem, t1=20.0, energy=True).constants
    assert constants is not None and constants.energy is not None
    overshoot, rate = (float(v) for v in constants.energy)
    x0, ts = jnp.array([1.5, 1.5, 1.5, 0.0, 0.0, 0.0]), np.linspace(0.0, 20.0, 401)
    sol = dvax.solve(
        mpc.problem, x0, 0.0, 20.0, ts=ts, rtol=1e-6, method=dvax.ETD4RK(), constants=constants
    )
    bound = dvax.bound_error(mpc.problem, sol, constants)
    size = np.linalg.norm(sol.xs, axis=1)
    certified = overshoot * np.exp(rate * ts) * size[0]
    masses = [Curve(ts, np.asarray(sol.xs[:, k]), f"mass {k + 1}", k) for k in range(3)]
    limits = [Curve(ts, np.full(ts.shape, v), "limit", None, "dash") for v in (-0.5, 0.5)]
    picture = panels_picture(
        "mpc", "Three masses under predictive control", "", [
            Panel(masses, "place"),
            Panel([Curve(ts, np.asarray(sol.us[:, 0]), "input", 3), *limits], "input"),
            Panel(
                [Curve(ts, size, "‖x‖", 0), Curve(ts, certified, "certified decay", 1, "dash")],
                "‖x‖", log=True,
            ),
        ], "time",
    )  # fmt: skip
    picture.still().savefig(folder / "predictive_control.png")
    return {
        "decay_rate": -rate,
        "overshoot": overshoot,
        "room": float((certified / size).min()),
        "largest_input": float(jnp.abs(sol.us[:, 0]).max()),
        "error_bound": float(bound.x.max()),
    }


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name} = {value:.6g}")  # noqa: T201
