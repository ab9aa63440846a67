"""Parameters and a network identified by derivatives of solutions, and by finite differences."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import inverse_problems as inverse
from ..clock import in_turn, timed
from ..inverse_problems import Fit, Model, fit
from ..layout import duration
from ..peers import ngspice
from ..section import Section, Table, compare

_RELATIVE_STEP = 1e-3
"""Of finite differences around adaptive steps, above the noise that these make."""
_EPOCHS = 5


def run(full: bool) -> Section:
    section = Section(
        title="identification: a contact field, a rectifier, and a network inside a law",
        fair=(
            "All fits use SciPy, from the same start with the same data and tolerances: its "
            "trust-region Gauss–Newton method for (a) and (b), L-BFGS for (c). The sides differ in "
            "the derivatives: jax.jacfwd or jax.grad of dvax.solve, forward differences around the "
            "same compiled dvax.solve with fixed steps, or forward differences around solve_ivp "
            "(LSODA, rtol 1e-7, the law solved by hand), with SciPy's relative step of 1.5e-8 and "
            f"with {_RELATIVE_STEP:g}. Times are those of whole fits after compilation. The two "
            "errors of a row are the largest distances to the true parameters in standard errors of "
            "the fit by derivatives; those of (c) are the losses after one epoch."
        ),
    )
    found = Table(
        "Parameters found by derivatives",
        ("problem", "parameter", "true", "found", "standard error", "error / standard error"),
        [],
    )
    costs = Table(
        "Evaluations and times",
        ("problem", "derivatives", "Jacobians or gradients", "solves", "derivative / solve", "time",
         "χ² or loss"),
        [],
    )  # fmt: skip
    section.tables += [found, costs]
    rounds = 7 if full else 3
    for side in (16, 100):
        name = f"(a) contact field, {side * side} points"
        model = inverse.field_model(side)
        truth, start = inverse.FIELD_TRUTH, inverse.FIELD_START
        data = inverse.noisy(jax.jit(model)(truth), 0)
        peer = inverse.field_model_scipy(side) if side == 16 else None
        names = inverse.FIELD_NAMES
        _parameters(section, name, names, truth, start, model, data, peer, rounds)
    name = "(b) rectifier"
    if ngspice.found():
        data = inverse.noisy(inverse.rectifier_by_ngspice(), 0)
        _parameters(
            section, name, inverse.RECTIFIER_NAMES, inverse.RECTIFIER_TRUTH,
            inverse.RECTIFIER_START, inverse.rectifier_model, data, inverse.rectifier_model_scipy,
            rounds,
        )  # fmt: skip
    else:
        section.notes.append(f"{name}: ngspice is not on the PATH (Debian: ngspice).")
    _network(section, found, costs, 10 if full else 4)
    return section


def _parameters(
    section: Section, name: str, names: tuple[str, ...], truth: np.ndarray, start: np.ndarray,
    model: Model, data: np.ndarray, peer: Model | None, rounds: int,
) -> None:  # fmt: skip
    """Fit by all sides, and add the rows of one problem."""
    found, costs = section.tables[:2]
    solve, jacobian = jax.jit(model), jax.jit(jax.jacfwd(model))
    sides: dict[str, Callable[[], Fit]] = {
        "jax.jacfwd": lambda: fit(solve, data, start, jacobian),
        "differences of dvax.solve": lambda: fit(solve, data, start),
    }
    if peer is not None:
        sides["differences of solve_ivp"] = lambda: fit(peer, data, start)
        sides[f"differences of solve_ivp, step {_RELATIVE_STEP:g}"] = lambda: fit(
            peer, data, start, relative_step=_RELATIVE_STEP
        )
    fits = {side: run() for side, run in sides.items()}
    taken = in_turn({side: timed(run) for side, run in sides.items()}, rounds, enough=20.0)
    cost = _relative(jacobian, solve, truth, rounds)
    best = fits["jax.jacfwd"]
    for label, true, value, spread in zip(names, truth, best.found, best.spread, strict=True):
        found.rows.append((
            name, label, f"{true:g}", f"{value:.5g}", f"{spread:.1g}",
            f"{abs(value - true) / spread:.2f}",
        ))  # fmt: skip
    for side, result in fits.items():
        seconds = float(np.median(taken[side]))
        costs.rows.append((
            name, side, f"{result.jacobians}", f"{result.solves}",
            f"{cost:.2f}" if side == "jax.jacfwd" else f"{len(truth)}",
            duration(seconds), f"{result.chi2:.3f}",
        ))  # fmt: skip
        if result is not best:
            off, other = (
                float(np.abs((each.found - truth) / best.spread).max()) for each in (best, result)
            )
            section.comparisons.append(
                compare(name, side, taken["jax.jacfwd"], taken[side], direction="other/dvax",
                        error=off, error_other=other)
            )  # fmt: skip


def _relative(
    derivative: Callable[..., Any], solve: Callable[..., Any], at: Any, rounds: int
) -> float:
    """Return the median time of a derivative in solves."""
    sides = {
        name: timed(lambda run=run: jax.block_until_ready(run(at)))
        for name, run in (("derivative", derivative), ("solve", solve))
    }
    taken = in_turn(sides, max(rounds, 5))
    return float(np.median(np.array(taken["derivative"]) / np.array(taken["solve"])))


def _network(section: Section, found: Table, costs: Table, seeds: int) -> None:
    training, name = inverse.Training(), "(c) network"
    history = Table(
        f"(c) A network of {5 * inverse.WIDTH} weights inside the law, after each epoch",
        (
            "records",
            "norms",
            "epoch",
            "loss",
            "status of γ",
            "proved γ",
            "least eigenvalue on a grid",
        ),
        [],
    )
    section.tables.append(history)
    for seed in range(seeds):
        loads, data, start = training.setting(seed)
        for limit, label in ((1.0, "limited"), (float("inf"), "free")):
            weights: Any = start
            for epoch in range(1, _EPOCHS + 1):
                result = training.epoch(weights, limit, loads, data)
                weights = result.x
                if seed and epoch < _EPOCHS:
                    continue
                theta = training.weights(weights, limit)
                check = training.verify(theta, loads[0])
                row = check["ass:strong_pseudomono"]
                gamma = float(check.constants.gamma) if row.status == "proved" else None
                least = inverse.sampled_modulus(inverse.network, theta)
                history.rows.append((
                    f"{seed}", label, f"{epoch}", f"{result.fun:.3f}", row.status,
                    "–" if gamma is None else f"{gamma:.4f}", f"{least:.4f}",
                ))  # fmt: skip
                if seed == 0 and limit == 1.0 and epoch == _EPOCHS:
                    found.rows.append((
                        name, "γ [1]", f"{inverse.UNKNOWN_MODULUS:g}",
                        f"{gamma or 0.0:.4f} ({row.status})", f"lower bound by the norms "
                        f"{1.0 - inverse.LIPSCHITZ:.1f}", "–",
                    ))  # fmt: skip
    loads, data, start = training.setting(0)

    def by(differences: bool) -> Callable[[], Any]:
        return lambda: training.epoch(start, 1.0, loads, data, differences=differences)

    sides = {"jax.grad": by(False), "differences of dvax.solve": by(True)}
    results = {side: run() for side, run in sides.items()}
    taken = in_turn({side: timed(run) for side, run in sides.items()}, 3)
    at = jnp.asarray(start)
    cost = _relative(
        lambda w: training.gradient(w, 1.0, loads, data),
        lambda w: training.loss(w, 1.0, loads, data), at, 5,
    )  # fmt: skip
    for side, result in results.items():
        by_gradient = side == "jax.grad"
        costs.rows.append((
            f"{name}, one epoch", side, f"{result.nfev if by_gradient else result.njev}",
            f"{result.nfev}", f"{cost:.2f}" if by_gradient else f"{len(start)}",
            duration(float(np.median(taken[side]))), f"{result.fun:.3f}",
        ))  # fmt: skip
    section.comparisons.append(
        compare(f"{name}, one epoch", "differences of dvax.solve", taken["jax.grad"],
                taken["differences of dvax.solve"], direction="other/dvax",
                error=float(results["jax.grad"].fun),
                error_other=float(results["differences of dvax.solve"].fun))
    )  # fmt: skip
