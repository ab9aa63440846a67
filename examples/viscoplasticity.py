"""A steel point on a strain path from tension to shear, by the law of Duvaut and Lions.

The program solves for three relaxation times, and draws the stress paths with the yield surface. The
page docs/models/duvaut-lions.md explains the model.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import dvax
from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.models import DuvautLions, VonMises
from dvax.models.duvaut_lions import mandel

jax.config.update("jax_enable_x64", True)
FOLDER = Path(__file__).parent


def main(folder: Path = FOLDER) -> dict[str, float]:
    """Draw the picture into `folder`, and return the numbers that the program prints."""
    shear = mandel(jnp.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    tension = mandel(jnp.diag(jnp.array([1.0, -0.5, -0.5])))
    corners = np.array(
        [(0, 0), (2, 0), (4, 0), (3.5, 2), (2, 3.5), (0, 4), (-2, 3), (-3, 0), (0, 0)]
    )
    times = np.linspace(0.0, 4.0, 9)
    strain = dvax.signals.Table(times, 1e-3 * (corners @ np.stack([tension, shear])))
    ts = np.linspace(0.0, 4.0, 401)
    limit, found, peaks, bounds = 250.0, [], {}, []
    for k, relaxation in enumerate((0.2, 0.05, 0.005)):
        steel = DuvautLions(
            bulk=160e3, shear=80e3, relaxation=relaxation, yields=VonMises(limit), strain=strain
        )
        sol = dvax.solve(
            steel.problem, steel.virgin, 0.0, 4.0, ts=ts, rtol=1e-6, atol=1e-9,
            constants=steel.constants,
        )  # fmt: skip
        bounds.append(float(dvax.bound_error(steel.problem, sol, steel.constants).x.max()))
        stress = np.asarray(jax.vmap(steel.stress)(sol.ts, sol.xs))
        along = [stress @ np.asarray(v) / np.linalg.norm(v) for v in (tension, shear)]
        # On these axes the von Mises cylinder is a circle with the radius √(2/3) σ_y.
        found.append(Curve(along[0], along[1], f"τ = {relaxation:g} s", k))
        peaks[f"peak_stress_{relaxation:g}"] = float(steel.figures(sol)["peak_stress"])
    angle = np.linspace(0.0, 2 * np.pi, 200)
    radius = np.sqrt(2 / 3) * limit
    circle = Curve(radius * np.cos(angle), radius * np.sin(angle), "yield surface", None, "dash")
    picture = panels_picture(
        "stress", "Stress of a point that yields with a delay", "",
        [Panel([*found, circle], "shear part of the stress", "MPa", share=2.0)],
        "tension part of the stress", "MPa",
    )  # fmt: skip
    drawn = picture.still()
    drawn.set_size_inches(7, 7)
    drawn.axes[0].set_aspect("equal")
    drawn.savefig(folder / "viscoplasticity.png")
    return {**peaks, "error_bound": max(bounds)}


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name} = {value:.6g}")  # noqa: T201
