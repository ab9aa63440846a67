"""Chopra's oscillators under the El Centro record, beside exact solutions and OpenSees."""

import os
import resource
import time
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import dvax
from dvax import generators, models, operators, sets, spaces
from dvax.formats import read_at2

from .. import yielding_frames
from ..clock import in_turn
from ..peers.opensees import OpenSees, python
from ..section import Section, Table, compare
from ..yielding_frames import Frame, exact, oscillator

FOLDER = "DVAX_EL_CENTRO"
GRAVITY, INCH = 9.80665, 0.0254
PERIOD, DAMPING = 0.5, 0.05
STRENGTHS = (1.0, 0.5, 0.25, 0.125)
PEAKS = (2.25, 1.62, 1.75, 2.07)
"""Chopra, Section 7.4: peak deformations (in) for the normalised yield strengths `STRENGTHS`."""
DUCTILITIES = (1.0, 1.44, 3.11, 7.36)
DESIGN = ((2.0, "37 %", 0.005), (4.0, "19.5 %", 0.0005), (8.0, "12 %", 0.005))
"""Chopra, Chapter 7: ductility factors, the yield strengths that they need, and half a digit."""
SPECTRAL = 0.919
"""The same: f_o of the elastic system, as a part of its weight."""
VISCOSITIES = (1e-3, 1e-5, 1e-8, 1e-10)
"""η/k in s."""
SHARPEST = VISCOSITIES[-1]
_PARTS = (1, 10, 100, 1000)
_FINE = 8


def record(folder: str | Path) -> tuple[float, np.ndarray]:
    """Return the step (s) and the samples (g) of elCentro.at2, with the zero at t = 0 that it lacks."""
    step, samples = read_at2(Path(folder) / "elCentro.at2")
    return step, np.concatenate([[0.0], samples])


class _Rate(eqx.Module):
    """f = (0, −a_g, u/τ) in SI units."""

    ground: models.Accelerogram
    rate: jax.Array

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return jnp.concatenate(
            [jnp.zeros_like(u), -INCH * self.ground(t) * jnp.ones_like(u), self.rate * u]
        )


class _ElasticPart(eqx.Module):
    """h = s."""

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return x[-(x.shape[0] // 3) :]


class HardeningFrame(NamedTuple):
    """A frame of `yielding_frames` with a > 0 for dvax, in SI units, with columns of viscosity τ.

    x = (e, v, s), u = proj of s on |s_i| ≤ y_i, s' = e' − (s − u)/τ. In ‖x‖² = Σ a k e² + m v² +
    (1 − a) k s², twice the energy, two trajectories never separate: the projection is monotone.
    """

    frame: Frame
    ground: models.Accelerogram
    tau: float

    @property
    def weights(self) -> np.ndarray:
        k, a = self.frame.stiffness, self.frame.hardening
        return np.concatenate([a * k, self.frame.mass, (1.0 - a) * k])

    @property
    def problem(self) -> dvax.Problem:
        frame, n = self.frame, len(self.frame.mass)
        D, a = frame.couplings, frame.hardening
        pull = -D.T * frame.stiffness / frame.mass[:, None]
        zero, eye = np.zeros((n, n)), np.eye(n)
        A = np.block([[zero, D, zero], [a * pull, -frame.damping * eye, (1.0 - a) * pull],
                      [zero, D, -eye / self.tau]])  # fmt: skip
        y = jnp.asarray(frame.yield_drift)
        return dvax.Problem(
            A=generators.Dense(jnp.asarray(A)), P=operators.Scaling(1.0), K=sets.Box(-y, y),
            f=_Rate(self.ground, jnp.asarray(1.0 / self.tau)), h=_ElasticPart(),
            state_space=spaces.L2(jnp.asarray(self.weights)), control_space=spaces.Euclidean(n),
        )  # fmt: skip

    @property
    def constants(self) -> dvax.Constants:
        """The constants: every term of the rate of the energy is ≤ 0."""
        plastic = (1.0 - self.frame.hardening) * self.frame.stiffness
        return dvax.Constants(
            gamma=1.0, L_F=1.0, alpha_h=1.0 / np.sqrt(plastic.min()), beta_h=0.0, alpha_f=0.0,
            beta_f=np.sqrt(plastic.max()) / self.tau, M=1.0, omega=0.0, m_P=1.0, norm_P_inv=1.0,
            energy=(1.0, 0.0), status="proved",
        )  # fmt: skip

    def solve(self, ts: np.ndarray) -> dvax.Solution:
        return dvax.solve(
            self.problem, jnp.zeros(3 * len(self.frame.mass)), 0.0, float(ts[-1]), ts=ts, rtol=1e-8,
            method=dvax.PiecewiseLinear(), constants=self.constants,
        )  # fmt: skip

    def limit_distance(self, xs: np.ndarray, ts: np.ndarray) -> np.ndarray:
        """Return a bound of the distance to the elastoplastic frame in (e, v), in the norm of x, at ts.

        |s − u| ≤ τ max |e'|, here of the saved times. The play operator has the Lipschitz constant 1,
        so this acts as a force of at most (1 − a) k τ max |e'| in each storey. The norm of a difference
        grows at most as its integral.
        """
        frame, n = self.frame, len(self.frame.mass)
        speed = np.maximum.accumulate(np.abs(xs[:, n : 2 * n] @ frame.couplings.T), axis=0)
        force = (1.0 - frame.hardening) * frame.stiffness * self.tau * speed
        pull = force @ np.abs(frame.couplings) / np.sqrt(frame.mass)
        return np.linalg.norm(pull, axis=1) * ts


def three_storeys() -> Frame:
    """Return a frame of 100 t and 80 MN/m in each storey, with 5 % hardening beyond 8 mm."""
    return Frame(np.full(3, 1e5), np.full(3, 8e7), np.full(3, 8e-3), 1.26, 0.05)


def run(full: bool) -> Section:
    section = Section(
        title="published_earthquake: Chopra's elastoplastic oscillators under the El Centro record",
        fair=(
            "Exact solutions are matrix exponentials from yielding to unloading, in long double, "
            "without code of dvax (benchmarks/yielding_frames.py), after the separation of the states "
            "that decay at the rate k/η. Errors: the largest of the displacement at the times of the "
            "record. dvax solves the viscoplastic frame; its error against the elastoplastic one "
            "includes the regularisation η/k. OpenSees has Steel01 and Newmark's method with constant "
            "average acceleration, in equal parts of the step of the record, in a process of its own; "
            "its time is that of the steps, that of dvax is the call, after compilation. All with one "
            "BLAS thread (OPENBLAS_NUM_THREADS=1)."
        ),
    )
    folder = os.environ.get(FOLDER)
    if folder is None or not (Path(folder) / "elCentro.at2").is_file():
        section.skipped = f"{FOLDER} names no folder that has elCentro.at2"
        return section
    jax.config.update("jax_enable_x64", True)
    step, samples = record(folder)
    interpreter = python()
    if interpreter is None:
        section.notes.append(
            "OpenSees: no Python here imports openseespy (DVAX_OPENSEES may name one)."
        )
    _published(section, step, samples, interpreter, 5 if full else 3)
    _design(section, step, samples)
    _hardening(section, step, samples, interpreter)
    _spectra(section, step, samples)
    return section


def _memory() -> str:
    return f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0:.0f}"


def _exact_peak(frame: Frame, ground: np.ndarray, step: float) -> tuple[float, np.ndarray]:
    """Return max |d| at all times, and the states at the times of the record."""
    ts = step / _FINE * np.arange((len(ground) - 1) * _FINE + 1)
    states, _ = exact(frame, ground, step, ts)
    at = np.arange(len(ground)) * step
    tops = yielding_frames.peaks(frame, states, lambda t: np.interp(t, at, ground), ts)
    return float(tops.max()), states[::_FINE]


def _published(
    section: Section, step: float, samples: np.ndarray, interpreter: str | None, rounds: int
) -> None:
    ground, unit = models.Accelerogram(step, samples), GRAVITY / INCH
    elastic = models.Frame(record=ground, period=PERIOD, damping=DAMPING)
    largest = elastic.figures()["largest_displacement"]
    strength = largest * (2.0 * np.pi / PERIOD) ** 2 / unit
    numbers = Table(
        f"Published numbers, T = {PERIOD} s, ζ = {DAMPING}, in in",
        ("strength", "published", "dvax", "exact", "with g = 386.4 in/s²", "ductility published",
         "dvax", "from the rounded peaks"),
        [],
    )  # fmt: skip
    errors = Table(
        f"Errors of the displacement in in, η/k = {SHARPEST:g} s",
        ("strength", "error of the viscoplastic frame", "bound", "status", "bound / error",
         "largest error / bound at one time", "distance to the elastoplastic frame", "its bound",
         "time", "MB"),
        [],
    )  # fmt: skip
    section.tables += [numbers, errors]
    for ratio, published, ductility in zip(STRENGTHS, PEAKS, DUCTILITIES, strict=True):
        limit = ratio * largest
        frame = oscillator(PERIOD, DAMPING, limit)
        top, states = _exact_peak(frame, unit * samples, step)
        made = models.Frame(record=ground, period=PERIOD, damping=DAMPING, yield_displacement=limit,
                            viscosity_ratio=SHARPEST)  # fmt: skip
        made.solve()
        start = time.perf_counter()
        sol = made.solve(constants=made.constants)
        seconds = time.perf_counter() - start
        row, distance = _errors(made, sol, frame, states, unit * samples, step)
        errors.rows.append((f"{ratio:g}", *row, f"{seconds:.1f} s", _memory()))
        peak = float(made.largest_displacement(sol))
        numbers.rows.append((
            f"{ratio:g}", f"{published}", f"{peak:.4f}", f"{top:.4f}", f"{peak * 386.4 / unit:.4f}",
            f"{ductility}", f"{peak / limit:.3f}", f"{published / (ratio * PEAKS[0]):.2f}",
        ))  # fmt: skip
        if interpreter is None:
            continue
        with OpenSees(interpreter) as peer:
            peer.load(frame, unit * samples, step)
            for parts in _PARTS if ratio == STRENGTHS[-1] else _PARTS[-1:]:
                theirs = np.abs(peer.run(parts)["drift"][:, 0] - states[:, 0]).max()

                def ours(made: models.Frame = made) -> float:
                    start = time.perf_counter()
                    jax.block_until_ready(made.solve().xs)
                    return time.perf_counter() - start

                def other(peer: OpenSees = peer, parts: int = parts) -> float:
                    return peer.run(parts)["seconds"]

                series = in_turn({"dvax": ours, "other": other}, rounds)
                section.comparisons.append(compare(
                    f"strength {ratio:g}; error of the displacement in in",
                    f"OpenSees, steps of {step / parts:g} s", series["dvax"], series["other"],
                    direction="other/dvax", error=distance, error_other=float(theirs),
                ))  # fmt: skip
    section.notes.append(
        f"The record: {len(samples) - 1} points, peak {np.abs(samples).max():.5f} g. Strength that the "
        f"elastic system needs: published {SPECTRAL} w, dvax {strength:.4f} w."
    )
    _stepping(section, step, samples)


def _errors(
    made: models.Frame, sol: dvax.Solution, frame: Frame, limit: np.ndarray, ground: np.ndarray,
    step: float,
) -> tuple[tuple[str, ...], float]:  # fmt: skip
    """Return the columns on errors, and the distance of d to the elastoplastic frame, whose states are
    `limit`. A quotient of a bound and an error of roundoff is of the norm of the state."""
    bound = dvax.bound_error(made.problem, sol, made.constants)
    bounds, w = np.asarray(bound.x)[::_FINE], 2.0 * np.pi / PERIOD
    ts = step * np.arange(len(ground))
    own, _ = exact(frame, ground, step, ts, float(made.viscosity_ratio))
    d, v, plastic = np.asarray(sol.xs)[::_FINE].T
    off = np.array([w * (d - own[:, 0]), v - own[:, 1], w * (plastic - own[:, 0] + own[:, 2])])
    error = np.linalg.norm(off, axis=0)
    distance = float(np.abs(d - limit[:, 0]).max())
    return (
        f"{np.abs(off[0]).max() / w:.1e}", f"{bounds.max() / w:.1e}", bound.status,
        f"{bounds.max() / error.max():.1g}", f"{(error[1:] / bounds[1:]).max():.1g}",
        f"{distance:.1e}", f"{float(made.elastoplastic_distance(sol)[-1]):.1e} (proved)",
    ), distance  # fmt: skip


def newmark(
    ground: np.ndarray, dt: float, limit: float, beta: float, period: float = PERIOD,
    damping: float = DAMPING,
) -> np.ndarray:  # fmt: skip
    """Return displacements by Newmark's method (γ = ½) with the yield condition solved in each step."""
    w = 2.0 * np.pi / period
    c, inertia = 2.0 * damping * w, 1.0 / (beta * dt * dt) + damping * w / (beta * dt)
    d = v = p = 0.0
    a, rows = -ground[0], [0.0]
    for load in ground[1:]:
        past = d / (beta * dt * dt) + v / (beta * dt) + (0.5 / beta - 1.0) * a
        past_damping = 0.5 / (beta * dt) * d + (0.5 / beta - 1.0) * v + dt * (0.25 / beta - 1.0) * a
        right = -load + past + c * past_damping
        new = (right + w * w * p) / (inertia + w * w)
        if abs(new - p) > limit:
            new = (right - w * w * np.copysign(limit, new - p)) / inertia
            p = new - np.copysign(limit, new - p)
        old, a = a, new / (beta * dt * dt) - past
        v, d = v + 0.5 * dt * (old + a), new
        rows.append(d)
    return np.array(rows)


def stepping_peaks(
    samples: np.ndarray, step: float, parts: int, beta: float, g: float
) -> list[float]:
    """Return the peaks for `STRENGTHS` by Newmark's method, relative to its own elastic peak."""
    at = np.arange((len(samples) - 1) * parts + 1) / parts
    ground = g * np.interp(at, np.arange(len(samples)), samples)
    found = [float(np.abs(newmark(ground, step / parts, np.inf, beta)).max())]
    for ratio in STRENGTHS[1:]:
        found.append(float(np.abs(newmark(ground, step / parts, ratio * found[0], beta)).max()))
    return found


def _stepping(section: Section, step: float, samples: np.ndarray) -> None:
    rows = []
    for name, beta in (("average", 0.25), ("linear", 1.0 / 6.0)):
        for parts in (1, 2, 4):
            peaks = stepping_peaks(samples, step, parts, beta, 386.4)
            rows.append((name, f"{step / parts:g} s", *(f"{peak:.4f}" for peak in peaks)))
    rows.append(("published", "", *(f"{peak}" for peak in PEAKS)))
    section.tables.append(Table(
        "Peaks by Newmark's method, g = 386.4 in/s², in in",
        ("acceleration", "step", *(f"strength {ratio:g}" for ratio in STRENGTHS)), rows,
    ))  # fmt: skip


def _design(section: Section, step: float, samples: np.ndarray) -> None:
    ground = models.Accelerogram(step, samples)
    elastic = models.Frame(record=ground, period=PERIOD, damping=DAMPING)
    largest = elastic.figures()["largest_displacement"]

    def excess(ratio: float, wanted: float) -> float:
        made = models.Frame(record=ground, period=PERIOD, damping=DAMPING, viscosity_ratio=SHARPEST,
                            yield_displacement=ratio * largest)  # fmt: skip
        return made.figures()["largest_displacement"] / (ratio * largest) - wanted

    rows = []
    for ductility, published, half in DESIGN:
        middle = float(published.split()[0]) / 100.0
        low, high = middle - 3.0 * half, middle + 3.0 * half
        if excess(low, ductility) < 0.0 or excess(high, ductility) > 0.0:
            low, high = 0.8 * middle, 1.2 * middle
        found = scipy.optimize.brentq(excess, low, high, args=(ductility,), xtol=1e-6)
        rows.append((f"{ductility:g}", published, f"{100.0 * found:.2f} %"))
    section.tables.append(Table(
        "Yield strength for a ductility, as a part of the elastic strength",
        ("ductility", "published", "dvax"), rows,
    ))  # fmt: skip


def _hardening(section: Section, step: float, samples: np.ndarray, interpreter: str | None) -> None:
    ground = models.Accelerogram(step, samples)
    ts, si = ground.knots(), GRAVITY * samples
    one = oscillator(PERIOD, DAMPING, 0.125 * PEAKS[0] * INCH, 0.05)
    table = Table(
        "Hardening of 5 %, in SI units: largest errors of all drifts at the times of the record, in m",
        ("frame", "η/k", "largest drift", "error", "bound", "status", "bound / error in its norm",
         "largest error / bound at one time",
         "distance to the elastoplastic frame", "its bound (estimated)", "time", "MB"),
        [],
    )  # fmt: skip
    section.tables.append(table)
    for name, frame in (("one storey", one), ("three storeys", three_storeys())):
        n = len(frame.mass)
        states, _ = exact(frame, si, step, ts)
        for tau in VISCOSITIES:
            made = HardeningFrame(frame, ground, tau)
            made.solve(ts)
            start = time.perf_counter()
            sol = made.solve(ts)
            seconds = time.perf_counter() - start
            bound = dvax.bound_error(made.problem, sol, made.constants)
            xs = np.asarray(sol.xs)
            own, _ = exact(frame, si, step, ts, tau)
            in_norm = np.sqrt(((xs - own) ** 2 * made.weights).sum(axis=1))
            worst, drift = float(np.max(bound.x)), float(np.sqrt(made.weights[:n].min()))
            distance = float(np.abs(xs - states)[:, :n].max())
            table.rows.append((
                name, f"{tau:g} s", f"{np.abs(xs[:, :n]).max():.6f}",
                f"{np.abs(xs - own)[:, :n].max():.1e}", f"{worst / drift:.1e}", bound.status,
                f"{worst / in_norm.max():.1g}",
                f"{(in_norm[1:] / np.asarray(bound.x)[1:]).max():.1g}", f"{distance:.1e}",
                f"{made.limit_distance(xs, ts).max() / drift:.1e}", f"{seconds:.1f} s", _memory(),
            ))  # fmt: skip
        if interpreter is None:
            continue
        made = HardeningFrame(frame, ground, SHARPEST)
        last = float(np.abs(np.asarray(made.solve(ts).xs) - states)[:, :n].max())
        with OpenSees(interpreter) as peer:
            peer.load(frame, si, step)
            for parts in _PARTS:
                theirs = float(np.abs(peer.run(parts)["drift"] - states[:, :n]).max())
                series = in_turn({
                    "dvax": lambda made=made: _seconds(made, ts),
                    "other": lambda peer=peer, parts=parts: peer.run(parts)["seconds"],
                }, 3)  # fmt: skip
                section.comparisons.append(compare(
                    f"{name} with hardening, η/k = {SHARPEST:g} s; error of drifts in m",
                    f"OpenSees, steps of {step / parts:g} s", series["dvax"], series["other"],
                    direction="other/dvax", error=last, error_other=theirs,
                ))  # fmt: skip


def _seconds(made: HardeningFrame, ts: np.ndarray) -> float:
    start = time.perf_counter()
    jax.block_until_ready(made.solve(ts).xs)
    return time.perf_counter() - start


def _spectra(section: Section, step: float, samples: np.ndarray) -> None:
    ground, unit = models.Accelerogram(step, samples), GRAVITY / INCH
    rows = []
    for period in (0.2, 0.5, 1.0, 2.0):
        elastic, _ = _exact_peak(oscillator(period, DAMPING, 1e6), unit * samples, step)
        limit = 0.25 * elastic
        top, _ = _exact_peak(oscillator(period, DAMPING, limit), unit * samples, step)
        row = [f"{period:g} s", f"{1e3 * INCH * elastic:.3f}", f"{1e3 * INCH * top:.4f}"]
        for tau in VISCOSITIES:
            made = models.Frame(record=ground, period=period, damping=DAMPING, yield_displacement=limit,
                                viscosity_ratio=tau)  # fmt: skip
            peak = made.figures()["largest_displacement"]
            row.append(f"{1e3 * INCH * peak:.4f}")
        rows.append(tuple(row))
    section.tables.append(Table(
        f"Response spectra for a quarter of the elastic strength, ζ = {DAMPING}: peaks in mm",
        ("T", "elastic, exact", "elastoplastic, exact",
         *(f"dvax, η/k = {tau:g} s" for tau in VISCOSITIES)),
        rows,
    ))  # fmt: skip
