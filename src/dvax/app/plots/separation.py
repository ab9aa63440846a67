"""Two trajectories from different initial states, against the certified decay between them.

Paper, cor:incremental_stability: ‖x₁(t) − x₂(t)‖ ≤ M e^{−(η − M L̃)t} ‖x₀₁ − x₀₂‖, and L times this
for u. The sharp bound uses the one-sided rate, which accounts for the sign of −d_x x.
"""

import numpy as np

from dvax.app.plots.panels import Curve, Panel, panels_picture
from dvax.app.plots.picture import Picture
from dvax.app.plots.run_reader import RunRecord
from dvax.app.plots.theme import number

ROUNDING = 1e-13
"""Part of its first value below which a separation is dominated by roundoff."""
# variable: (legend, colour, dash)
CURVES = {
    "separation_{}": ("observed", 0, "solid"),
    "separation_bound_{}": ("certified, e^(−(η−ML̃)t)", 1, "dash"),
    "separation_sharp_{}": ("sharper, one-sided rate", 2, "dot"),
}


def separation_picture(run: RunRecord) -> Picture | None:
    """x above, u below, both logarithmic; None where the run had no companion trajectory."""
    panels = []
    for letter in "xu":
        names = {name.format(letter): style for name, style in CURVES.items()}
        curves = [
            Curve(run.time, run.series(name), *style)
            for name, style in names.items()
            if run.has(name)
        ]
        if curves:
            unit = run.unit(f"separation_{letter}")
            panels.append(Panel(curves, f"‖{letter}₁ − {letter}₂‖", unit, log=True))
    if not panels:
        return None
    return panels_picture(
        "separation", "Two trajectories against the certified decay", _caption(run), panels,
        "time", run.unit("time"),
    )  # fmt: skip


def _caption(run: RunRecord) -> str:
    parts = [
        "A second trajectory starts from a perturbed initial state. The certified decay is the "
        "paper's (cor:incremental_stability); it uses |d_x| and not its sign, so it is "
        "conservative. The sharper curve uses the one-sided (logarithmic-norm) rate."
    ]
    if run.has("separation_bound_x"):
        observed, bound = run.series("separation_x"), run.series("separation_bound_x")
        finite = (bound > 0) & np.isfinite(bound)
        if finite.any():
            ratio = float((observed[finite] / bound[finite]).max())
            parts.append(
                "The largest ratio of the observed to the certified separation of x is "
                f"{number(ratio, 3)}."
            )
    observed = [run.series(name) for name in ("separation_x", "separation_u") if run.has(name)]
    if any((values[1:] < ROUNDING * values[0]).any() for values in observed):
        parts.append(
            f"Where it has fallen below {number(ROUNDING)} of its first value, what is observed is "
            "floating-point rounding, which no bound covers."
        )
    if any((values <= 0).any() for values in observed):
        parts.append("A separation of exactly zero is left as a gap.")
    return " ".join(parts)
