"""A plate under a moving heat source, with saturated heaters.

The program solves for the temperature with a proved error bound. It draws the temperature and the
regions of least power, regulation and full power at the end. The page docs/models/thermostat.md
explains the model.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import rc_context
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

import dvax
from dvax.app.plots.theme import REGIME_COLOURS, STILL_STYLE, still_axes
from dvax.models import Thermostat

jax.config.update("jax_enable_x64", True)
FOLDER = Path(__file__).parent


def main(folder: Path = FOLDER) -> dict[str, float]:
    """Draw the picture into `folder`, and return the numbers that the program prints."""

    def flame(t):
        return 1.5 * jnp.exp(-30.0 * ((s1 - 0.5 - 0.3 * jnp.sin(t)) ** 2 + (s2 - 0.5) ** 2))

    plate = Thermostat(
        shape=(192, 128), lengths=(1.5, 1.0), boundary="dirichlet", diffusion=0.05, gain=6.0,
        reference=1.0, lower=0.0, upper=2.0, load=flame,
    )  # fmt: skip
    s1, s2 = plate.points
    ts = np.linspace(0.0, 6.0, 25)
    sol = dvax.solve(
        plate.problem, jnp.zeros((192, 128)), 0.0, 6.0, ts=ts, rtol=1e-4, atol=1e-6,
        constants=plate.constants,
    )  # fmt: skip
    bound = dvax.bound_error(plate.problem, sol, plate.constants)
    # 0: least power, 1: regulating, 2: full power; the colours become stronger.
    order = np.asarray(plate.regimes(ts[-1], sol.xs[-1])) + 1
    with rc_context({**STILL_STYLE, "axes.grid": False}):
        drawn, axes = still_axes(1, 2, figsize=(10, 4))
        extent = (0.0, 1.5, 0.0, 1.0)
        heat = axes[0].imshow(np.asarray(sol.xs[-1]).T, origin="lower", extent=extent)
        drawn.colorbar(heat, ax=axes[0], label="temperature", shrink=0.8)
        axes[1].imshow(
            order.T, origin="lower", extent=extent, cmap=ListedColormap(REGIME_COLOURS), vmin=-0.5,
            vmax=2.5, interpolation="nearest",
        )  # fmt: skip
        words = ("least power", "regulating", "full power")
        axes[1].legend(
            handles=[Patch(color=c, label=w) for c, w in zip(REGIME_COLOURS, words, strict=True)],
            loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=3,
        )  # fmt: skip
        for place, title in zip(axes, ("Temperature at t = 6", "Heaters at t = 6"), strict=True):
            place.set_title(title)
            place.set_xlabel("s1")
            place.set_ylabel("s2")
        drawn.savefig(folder / "thermostat.png")
    figures = plate.figures(sol)
    return {
        **{name: float(figures[name]) for name in ("mean_temperature", "power")},
        "error_bound": float(bound.x.max()),
        "decay_rate": float(plate.constants.sharp_decay_rate),
    }


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name} = {value:.6g}")  # noqa: T201
