"""A norm ‖d‖²_Q = ⟨Qd, d⟩ in which trajectories contract, from a semidefinite program.

For the difference d = Δx, v = Δu of two solutions let I ≤ Q ≤ κI. As in `one_sided`, with multipliers
Λ ≥ 0 of the law (one number, or one per component for a box and a diagonal P, since the law then
holds in each component),

    d/dt ‖d‖²_Q ≤ 2⟨Q(A + F_x)d + QF_u v, d⟩ + 2⟨Λ(H_x d − (I − H_u)v), Pv⟩ ≤ 2μ‖d‖²_Q

wherever the matrix of the quadratic form in (d, v),

    ⎡ QG + GᵀQ − 2μQ     QF_u + H_xᵀΛP ⎤
    ⎣       ·                −N_Λ      ⎦ ⪯ 0,   G = A + F_x,  N_Λ = PΛ(I − H_u) + (I − H_u)ᵀΛP.

Then ‖x₁ − x₂‖ ≤ √κ e^{μt}‖Δx₀‖, and a defect acts with the same M = √κ and rate. For a fixed μ,
minimising κ is a semidefinite program in (Q, Λ, κ). The solver only proposes Q and Λ: κ and μ are then
computed from them by eigenvalues, so the bound does not depend on the solver's accuracy.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..errors import input_error
from ..programs.slope import TooLarge
from .blocks import as_one_matrix
from .formulas import growth_integral
from .system import Jacobians, System

MAX_UNKNOWNS = 40
"""Largest number of unknowns of x and u together for which the program is solved."""

_DERIVATIVES = ("∂f/∂x", "∂f/∂u", "∂h/∂x", "∂h/∂u")
_BISECTIONS = 12
_SHARES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7)
_SMALLEST_MULTIPLIER = 1e-8


class EnergyNorm(NamedTuple):
    """‖x₁ − x₂‖ ≤ M e^{rate·t}‖Δx₀‖, since ‖·‖_Q contracts at this rate.

    Q is given in coordinates in which the norm of the state space is Euclidean, that is, entries are
    multiplied by the square roots of the weights.
    """

    Q: np.ndarray
    M: float
    rate: float


def energy_norm(system: System, J: Jacobians, pointwise: bool, T: float) -> EnergyNorm | str:
    """Return the Q that minimises √κ Φ_μ(T), the factor by which a constant defect grows, or the reason
    for which there is none: the derivatives of f and h are not constant, or no Q improves on the norm
    of the space.

    **Raises:** `dvax.InputError` if the solver is not installed.
    """
    data = _data(system, J, pointwise)
    if isinstance(data, str):
        return data
    # If u is constant, no norm contracts faster than the linear part.
    low = float(np.max(np.real(np.linalg.eigvals(data.G))))
    start = high = _rate_of_space_norm(data)
    if not np.isfinite(high):
        return "the law is not strongly monotone in the form that the search needs"
    norms = []
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        proposal = _solve_program(data, middle)
        if proposal is None:
            low = middle
        else:
            high = middle
    for share in _SHARES:
        mu = high + share * (start - high) + 1e-9 * (1.0 + abs(high))
        proposal = _solve_program(data, mu)
        if proposal is not None:
            norms.append(_certify(*proposal, data))
    norms = [norm for norm in norms if norm is not None]
    if not norms:
        return "the solver of the semidefinite program found none"
    return min(norms, key=lambda norm: norm.M * float(growth_integral(norm.rate, T)))


class _Data(NamedTuple):
    """G, F_u, H_x, I − H_u and P as matrices; `componentwise`: each component has a multiplier."""

    G: np.ndarray
    F_u: np.ndarray
    H_x: np.ndarray
    I_minus_H_u: np.ndarray
    P: np.ndarray
    componentwise: bool


def _data(system: System, J: Jacobians, pointwise: bool) -> _Data | str:
    """Return the matrices, or why there are none."""
    names = (*_DERIVATIVES, "A", "P")
    found = dict(zip(names, (J.f_x, J.f_u, J.h_x, J.h_u, system.A, system.P)))
    blocks = {name: block for name, block in found.items() if block is not None}
    if len(blocks) < len(found):
        return f"no matrix is known for {', '.join(name for name in found if name not in blocks)}"
    moving = [name for name in _DERIVATIVES if not blocks[name].exact]
    if moving:
        return f"the derivatives {', '.join(moving)} are not proved constant"
    if not (blocks["A"].exact and blocks["P"].exact):
        return "A and P are not known exactly as matrices"
    too_large = f"x and u have more than {MAX_UNKNOWNS} unknowns together"
    try:
        f_x, f_u, h_x, h_u, A, P = (as_one_matrix(block).center[0] for block in blocks.values())
    except TooLarge:
        return too_large
    if len(A) + len(P) > MAX_UNKNOWNS:
        return too_large
    return _Data(A + f_x, f_u, h_x, np.eye(len(P)) - h_u, P, pointwise)


def _form(Q: np.ndarray, multipliers: np.ndarray, data: _Data, mu: float) -> np.ndarray:
    """Return the matrix of the quadratic form in (d, v)."""
    L = np.diag(multipliers)
    corner = Q @ data.G + data.G.T @ Q - 2.0 * mu * Q
    side = Q @ data.F_u + data.H_x.T @ L @ data.P
    push = data.P @ L @ data.I_minus_H_u
    return np.block([[corner, side], [side.T, -(push + push.T)]])


def _multiplier_vector(numbers: np.ndarray, data: _Data) -> np.ndarray:
    return numbers if data.componentwise else np.full(len(data.P), numbers[0])


def _certify(Q: np.ndarray, multipliers: np.ndarray, data: _Data) -> EnergyNorm | None:
    """Return the norm of Q with M and its rate from eigenvalues, or None if it has none."""
    ends = np.linalg.eigvalsh(Q)
    rate = _rate_of(Q, multipliers, data) if ends[0] > 0 else np.inf
    if not np.isfinite(rate):
        return None
    return EnergyNorm(Q, float(np.sqrt(ends[-1] / ends[0])), rate)


def _rate_of(Q: np.ndarray, multipliers: np.ndarray, data: _Data) -> float:
    """Return the smallest μ for this Q and these multipliers, by eigenvalues."""
    n = len(Q)
    form = _form(Q, multipliers, data, 0.0)
    N = -form[n:, n:]
    if not np.linalg.eigvalsh(N)[0] > 0:
        return np.inf
    S = form[:n, :n] + form[:n, n:] @ np.linalg.solve(N, form[n:, :n])
    values, vectors = np.linalg.eigh(Q)
    root = vectors / np.sqrt(values)
    reduced = root.T @ S @ root
    reduced = 0.5 * (reduced + reduced.T)
    return 0.5 * float(np.linalg.eigvalsh(reduced)[-1]) + 1e-13 * float(np.abs(reduced).max())


def _rate_of_space_norm(data: _Data) -> float:
    """Return μ for Q = I and one multiplier."""
    identity, ones = np.eye(len(data.G)), np.ones(len(data.P))
    return min(_rate_of(identity, t * ones, data) for t in np.geomspace(1e-6, 1e6, 121))


def _solve_program(data: _Data, mu: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the Q and multipliers with the smallest κ for this μ, or None if there are none."""
    n, m = len(data.G), len(data.P)
    count = m if data.componentwise else 1
    pairs = [(i, j) for i in range(n) for j in range(i, n)]

    def unpack(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        Q = np.zeros((n, n))
        for value, (i, j) in zip(z, pairs):
            Q[i, j] = Q[j, i] = value
        return Q, z[len(pairs) : len(pairs) + count], float(z[-1])

    def cones(z: np.ndarray) -> list[np.ndarray]:
        Q, numbers, kappa = unpack(z)
        form = _form(Q, _multiplier_vector(numbers, data), data, mu)
        return [-form, Q, kappa * np.eye(n) - Q]

    z = _minimise(cones, len(pairs) + count + 1, [np.zeros((n + m, n + m)), -np.eye(n), None],
                   range(len(pairs), len(pairs) + count))  # fmt: skip
    if z is None:
        return None
    Q, numbers, _ = unpack(z)
    return Q, _multiplier_vector(np.maximum(numbers, _SMALLEST_MULTIPLIER), data)


def _minimise(
    cones: Callable[[np.ndarray], list[np.ndarray]], size: int, offsets: list, positive: range
) -> np.ndarray | None:
    """Return the z that minimises its last entry subject to cones(z) + offsets ⪰ 0 and positive entries
    at `positive`, with linear functions `cones`; None if the solver finds none."""
    import scipy.sparse as sp  # a slow import that only this function needs

    clarabel = _solver()
    units = [cones(e) for e in np.eye(size)]
    rows, offset, kinds = [], [], []
    for k, part in enumerate(offsets):
        matrices = [unit[k] for unit in units]
        rows.append(-np.stack([_packed(S) for S in matrices], axis=1))
        offset.append(np.zeros(len(rows[-1])) if part is None else _packed(part))
        kinds.append(clarabel.PSDTriangleConeT(len(matrices[0])))
    for k in positive:
        row = np.zeros((1, size))
        row[0, k] = -1.0
        rows.append(row)
        offset.append(np.array([-_SMALLEST_MULTIPLIER]))
        kinds.append(clarabel.NonnegativeConeT(1))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    objective = np.zeros(size)
    objective[-1] = 1.0
    solver = clarabel.DefaultSolver(
        sp.csc_matrix((size, size)), objective, sp.csc_matrix(np.concatenate(rows)),
        np.concatenate(offset), kinds, settings,
    )  # fmt: skip
    answer = solver.solve()
    solved = (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved)
    return np.array(answer.x) if answer.status in solved else None


def _packed(S: np.ndarray) -> np.ndarray:
    """Return the upper triangle by columns, off-diagonal entries times √2 to preserve inner
    products."""
    i, j = np.triu_indices(len(S))
    order = np.lexsort((i, j))
    i, j = i[order], j[order]
    return S[i, j] * np.where(i == j, 1.0, np.sqrt(2.0))


def _solver() -> Any:
    try:
        import clarabel
    except ModuleNotFoundError as error:
        raise input_error(
            "dvax.verify(energy=True)",
            "no module named clarabel",
            "the norm is found by a semidefinite program, which Clarabel solves",
            "pip install 'dvax[energy]', or omit energy",
        ) from error
    return clarabel
