"""Circuits with ideal diodes, from a netlist."""

import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ... import _tree
from ...errors import InputProblem, Problems, input_error
from ...evolution import ExpRosenbrock, PiecewiseLinear, Solution, solve
from ...formats.netlist import Netlist, read_netlist
from ...generators import Dense
from ...operators import Diagonal, Scaling
from ...problem import Problem
from ...sets import Box
from ...signals import AbstractSignal
from ...spaces import L2, Euclidean
from ...theory import Constants
from . import topology
from .nodal import Equations, assemble

_SINGULAR = 1e-14
"""An eigenvalue of D below this fraction of ‖D‖ is zero up to roundoff."""


class Circuit(eqx.Module):
    """A circuit of resistors, inductors, capacitors, sources and ideal diodes.

        x' = A x + B u + b s(t)                        Kirchhoff's laws
        0 ∈ D u + C x + e s(t) + N_K(u),  K = {u ≥ 0}  ideal diodes: 0 ≤ current ⟂ blocked voltage ≥ 0

    x holds the voltages of the capacitors (V), then the currents of the inductors (A), in the order of
    the netlist. u holds the currents of the diodes (A). For diodes that are the only connection of a
    part of the circuit, u holds the blocked voltage instead (V, `blocking`). s holds the sources.
    P = 1, or diagonal if u has both units, and h = u − P⁻¹(Du + Cx + e s). The squared norm of x is
    twice the stored energy, ‖x‖² = Σ C v² + Σ L i². A circuit is passive, so the distance between two
    trajectories never increases in this norm.

    **Arguments:** `netlist`: its text, or the result of `read_netlist`; `r_on` (ohm), `g_leak`
    (siemens): the series resistance and the parallel conductance of every diode whose line has no R=
    and no G=, respectively.

    **Exactness.** The model is exact if every diode current meets a resistance, so that
    γ = λ_min(D) > 0. If γ = 0 (bridges; diodes that only other diodes, inductors or current sources
    connect) the constructor raises an error that names the diodes. With `r_on` and `g_leak` the circuit
    is regularised; it converges to the ideal circuit as both tend to 0. `fit` states which case holds.

    **Raises:** `dvax.InputError` with the lines of all problems: syntax errors, floating nodes, loops
    of voltage sources and capacitors, cuts of inductors and current sources, γ = 0.

    **Source:** Acary and Brogliato (2008), Chapter 1; the circuits are those of its Section 1.1.

    ```python
    >>> import dvax
    >>> from dvax.models import Circuit
    >>> tank = Circuit("C1 1 0 1u IC=10\\nL1 1 0 10m\\nD1 1 0 R=1k")
    >>> tank.fit, tank.states, float(tank.constants.gamma)
    ('exact', ('C1', 'L1'), 1000.0)
    >>> {name: f"{value:.6f}" for name, value in tank.figures(5e-3).items()}
    {'final_C1': '2.800403', 'final_L1': '-0.008440'}

    ```
    """

    A: jax.Array
    B: jax.Array
    b: jax.Array
    C: jax.Array
    D: jax.Array
    e: jax.Array
    V: jax.Array
    P: jax.Array
    storage: jax.Array
    x0: jax.Array
    sources: tuple[AbstractSignal, ...]
    feeds: tuple[tuple[str, str], ...] = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    diodes: tuple[str, ...] = eqx.field(static=True)
    blocking: tuple[bool, ...] = eqx.field(static=True)
    nodes: tuple[str, ...] = eqx.field(static=True)
    fit: str = eqx.field(static=True)

    def __init__(
        self, netlist: str | Netlist, *, r_on: float | None = None, g_leak: float | None = None
    ):
        netlist = read_netlist(netlist) if isinstance(netlist, str) else netlist
        _check_options(r_on, g_leak)
        diodes = netlist.of("D")
        topology.check(netlist, leaks=g_leak is not None)
        equations = assemble(netlist, r_on or 0.0, g_leak or 0.0)
        _check_modulus(netlist, equations)
        for name in ("A", "B", "b", "C", "D", "e", "V", "storage"):
            setattr(self, name, jnp.asarray(getattr(equations, name)))
        self.P = jnp.asarray(_scaling(equations))
        stores = [*netlist.of("C"), *netlist.of("L")]
        self.x0 = jnp.asarray(np.array([element.initial for element in stores]))
        feeds = [*netlist.of("V"), *netlist.of("I")]
        self.sources = tuple(e.source for e in feeds if e.source is not None)
        self.feeds = tuple((e.name, netlist.place(e)) for e in feeds)
        self.states = tuple(element.name for element in stores)
        self.diodes = tuple(element.name for element in diodes)
        self.blocking = tuple(map(bool, equations.blocking))
        self.nodes = equations.nodes
        added = {
            f"r_on = {r_on} Ω": r_on is not None and any(e.series is None for e in diodes),
            f"g_leak = {g_leak} S": g_leak is not None and any(e.leak is None for e in diodes),
        }
        by = " and ".join(name for name, used in added.items() if used)
        self.fit = f"regularised by {by}: ideal diodes in the limit 0" if by else "exact"

    @classmethod
    def from_file(cls, path: str | Path, **options: Any) -> "Circuit":
        """Return the circuit of a netlist file; error messages name the file.

        **Raises:** `dvax.InputError` as the class does, and if the file is not UTF-8 text; `OSError` if
        it cannot be read.
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise input_error(
                path.name, f"a byte that is not UTF-8 at position {error.start}",
                "a netlist must be UTF-8 text", "Save it as UTF-8",
            ) from error  # fmt: skip
        return cls(read_netlist(text, path.name), **options)

    @property
    def problem(self) -> Problem:
        """The coupled problem, in the energy norm."""
        return Problem(
            A=Dense(self.A),
            P=Diagonal(self.P) if any(self.blocking) else Scaling(1.0),
            K=Box(0.0, np.inf),
            f=_Rate(self.B, self.b, self.sources),
            h=_Law(self.P, self.C, self.D, self.e, self.sources),
            state_space=L2(self.storage),
            control_space=Euclidean(len(self.diodes)),
        )

    @property
    def constants(self) -> Constants:
        """The proved constants in the energy norm.

        With D' = P⁻¹DP⁻¹, C' = P⁻¹C, B' = BP⁻¹: γ = λ_min of the symmetric part of D', L_F = ‖D'‖,
        α_h = ‖C'‖, β_h = ‖1 − D'P‖, α_f = 0, β_f = ‖B‖, M = 1, ω = ½λ_max(A + A*). The law is monotone,
        so the one-sided rate is

            μ = ½ λ_max(A + A* + (B' − C'*)(D' + D'*)⁻¹(B' − C'*)*) ≤ 0,

        since the circuit is passive: ⟨D'v + C'd, v⟩ − ⟨Ad + B'v, d⟩ is the power lost in resistors."""
        c: Circuit = _tree.host(self)
        root = np.sqrt(c.storage)
        A, B, C = root[:, None] * c.A / root, root[:, None] * c.B, c.C / root / c.P[:, None]
        D = c.D / c.P / c.P[:, None]
        coupling = B / c.P - C.T
        # The same computation as in the solver: for a lossless circuit ω is 0 up to roundoff.
        growth = Dense(self.A).growth(L2(self.storage))
        rate = A + A.T + coupling @ np.linalg.solve(D + D.T, coupling.T)
        return Constants(
            gamma=0.5 * np.linalg.eigvalsh(D + D.T)[0],
            L_F=np.linalg.norm(D, 2),
            alpha_h=np.linalg.norm(C, 2),
            beta_h=np.linalg.norm(np.eye(len(D)) - D * c.P, 2),
            alpha_f=0.0,
            beta_f=np.linalg.norm(B, 2),
            M=growth.M,
            omega=growth.omega,
            m_P=np.min(1.0 / c.P),
            norm_P_inv=np.max(1.0 / c.P),
            # Passivity proves a rate ≤ 0; a positive value is roundoff.
            one_sided=min(0.5 * np.linalg.eigvalsh(rate)[-1], 0.0),
            status="proved",
        )

    def solve(self, t_end: Any, ts: Any = None, **settings: Any) -> Solution:
        """Solve from the initial values of the netlist at t = 0 to `t_end` (s), and save at `ts`.

        The method is `dvax.PiecewiseLinear`, which steps from switching to switching at a cost that
        does not depend on the stiffness. With traced values (`jax.jit`, `jax.grad`) or a given `dt` it
        is `dvax.ExpRosenbrock`. The defaults are rtol = 1e-8 and atol = 1e-9 (V and A, root mean
        square). `settings` are passed to `dvax.solve`. Raises the errors of `check_sources`."""
        self.check_sources(t_end)
        settings = {"rtol": 1e-8, "atol": 1e-9} | settings
        if settings.get("method") is None:
            traced = not _tree.is_concrete(self, t_end, ts, *settings.values())
            use_steps = traced or settings.get("dt") is not None
            settings["method"] = ExpRosenbrock() if use_steps else PiecewiseLinear()
        return solve(self.problem, self.x0, 0.0, t_end, ts=ts, **settings)

    def check_sources(self, t_end: Any) -> None:
        """Check that every source is defined until `t_end` (s).

        **Raises:** `dvax.InputError` with the lines of those that end before.
        """
        if not _tree.is_concrete(t_end, self.sources):
            return
        end = float(t_end)
        short = Problems(
            InputProblem(
                place, f"{name}, which is defined from 0 to {last:.12g} s",
                f"the run is from 0 to t_end = {end:.12g} s, and sources are not extrapolated",
                f"Add a last PWL point at {end:.12g}, or set t_end = {last:.12g}",
            )
            for (name, place), source in zip(self.feeds, self.sources, strict=True)
            if (last := float(source.span()[1])) < end
        )  # fmt: skip
        short.raise_any()

    def voltages(self, t: Any, x: Any, u: Any) -> jax.Array:
        """Return the voltages of the `nodes` against ground (V)."""
        return self.V @ jnp.concatenate([x, _values(self.sources, t), u])

    def currents(self, t: Any, x: Any, u: Any) -> jax.Array:
        """Return the currents through the ideal parts of the diodes (A)."""
        other = self.D @ u + self.C @ x + self.e @ _values(self.sources, t)
        return jnp.where(jnp.asarray(self.blocking), other, u)

    def figures(self, t_end: Any, **settings: Any) -> dict[str, Any]:
        """Return `final_C1` and so on: each of the `states` at `t_end`."""
        last = self.solve(t_end, **settings).xs[-1]
        return {f"final_{name}": float(v) for name, v in zip(self.states, last, strict=True)}


class _Rate(eqx.Module):
    """f = B u + b s(t)."""

    B: jax.Array
    b: jax.Array
    sources: tuple[AbstractSignal, ...]

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return self.B @ u + self.b @ _values(self.sources, t)


class _Law(eqx.Module):
    """h = u − P⁻¹(D u + C x + e s(t))."""

    P: jax.Array
    C: jax.Array
    D: jax.Array
    e: jax.Array
    sources: tuple[AbstractSignal, ...]

    def __call__(self, t: Any, x: Any, u: Any, args: Any) -> jax.Array:
        return u - (self.D @ u + self.C @ x + self.e @ _values(self.sources, t)) / self.P


def _values(sources: tuple[AbstractSignal, ...], t: Any) -> jax.Array:
    return jnp.stack([source(t) for source in sources]) if sources else jnp.zeros(0)


def _check_options(r_on: float | None, g_leak: float | None) -> None:
    wrong = Problems(
        InputProblem(
            f"dvax.models.Circuit({name})", str(value), f"it must be a positive {what}, or None to "
            "use the diodes of the netlist", "Try r_on = 0.1 and g_leak = 1e-9, then smaller values",
        )
        for name, value, what in (("r_on", r_on, "resistance"), ("g_leak", g_leak, "conductance"))
        if value is not None and not (math.isfinite(value) and value > 0)
    )  # fmt: skip
    wrong.raise_any()


def _check_modulus(netlist: Netlist, equations: Equations) -> None:
    """Raise an `InputError` that names the diodes which cause γ = 0.

    Diodes with the blocked voltage as unknown have a parallel conductance, so their part of D is
    positive definite."""
    conducting = np.flatnonzero(~equations.blocking)
    if conducting.size == 0:
        return
    eigenvalues, vectors = np.linalg.eigh(equations.D[np.ix_(conducting, conducting)])
    null = vectors[:, eigenvalues <= _SINGULAR * eigenvalues[-1]]
    involved = np.max(np.abs(null), axis=1, initial=0.0) > 1e-6
    named = [netlist.of("D")[k] for k in conducting[involved]]
    if named:
        one = len(named) == 1
        names = ", ".join(e.name for e in named)
        why = "its current meets" if one else "some combination of their currents meets"
        raise input_error(
            netlist.place(*named), f"{names} without R=",
            f"{why} no resistance, so γ = λ_min(D) = 0 and the law does not determine "
            + ("it" if one else "them"),
            "Write R=0.1 there, or regularise all diodes: r_on = 0.1 and g_leak = 1e-9",
        )  # fmt: skip


def _scaling(equations: Equations) -> np.ndarray:
    """Return the diagonal of P.

    If u contains currents and voltages, all entries of y = P u have the unit √watt. The impedance
    between the two is the one that maximises γ.
    """
    conducting, blocking = ~equations.blocking, equations.blocking
    if not blocking.any() or not conducting.any():
        return np.ones(len(blocking))
    resistance, conductance = (
        np.linalg.eigvalsh(equations.D[np.ix_(mask, mask)])[0] for mask in (conducting, blocking)
    )
    impedance = resistance / conductance
    return np.where(conducting, impedance**0.25, impedance**-0.25)
