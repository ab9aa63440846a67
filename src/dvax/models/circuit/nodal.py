"""From the elements to the matrices of the class, by nodal analysis.

Capacitors are held at their voltage and inductors at their current. So is the ideal part of each
diode, at its unknown y: the current through it, or, for as many diodes as it takes to join what only
diodes join, the voltage that it blocks (a proper tree: Chua and Lin 1975, Chapter 8). What is left
is resistive. Nodes joined by branches of known voltage e differ by these alone, so the node voltages
are v = Te + Nz, with one unknown z for each group of such nodes that ground is not in. With g the
conductances, A_r and A_i the incidences of resistors and of branches of known current i, Kirchhoff's
law Nᵀ(A_r g A_rᵀ v + A_i i) = 0 gives z, and the currents through the branches of known voltage are
j = −Tᵀ(A_r g A_rᵀ v + A_i i). With the factors √g A_rᵀ N = QR and

    Z = (1 − QQᵀ)√g A_rᵀ T,   W = Qᵀ√g A_rᵀ T,   U = R⁻ᵀNᵀA_i,   K = TᵀA_i − WᵀU,

    j = −ZᵀZ e − K i,   A_iᵀv = Kᵀe − UᵀU i.

The two squares are positive semidefinite and what couples them is skew, to the last digit: the circuit
is passive in floating point too. Where no loop and no cut is in the way (`topology`), R is invertible.

A diode of known current y, with a resistance r in series and a conductance g across its ideal part,
is a conductance gs beside a source of current sy, s = 1/(1 + gr), and its ideal part blocks
s(ry − v_D). One of known blocked voltage y conducts j + gy, and r is one of the resistors.
"""

from typing import NamedTuple

import numpy as np

from ...formats.netlist import GROUND, Netlist
from .topology import Groups

Matrix = np.ndarray
Branch = tuple[str, str]


class Equations(NamedTuple):
    """x' = Ax + By + b s,   w = Dy + Cx + e s,   0 ≤ y ⟂ w ≥ 0,   v = V (x, s, y).

    `blocking` says of which diodes y is the blocked voltage and w the current, and not the other way
    round. `storage` holds C (farad) and L (henry) of the states: the energy is ½ Σ storage x². `V`
    gives the voltages of the `nodes`.
    """

    A: Matrix
    B: Matrix
    b: Matrix
    C: Matrix
    D: Matrix
    e: Matrix
    V: Matrix
    storage: Matrix
    blocking: Matrix
    nodes: tuple[str, ...]


class _Port(NamedTuple):
    """A diode: the ends of its branch, s, and what joins the diagonal of D: sr or g."""

    ends: Branch
    blocking: bool
    scale: float
    own: float


def assemble(netlist: Netlist, r_on: float, g_leak: float) -> Equations:
    """The equations; a diode without R= gets `r_on`, and one without G= `g_leak`, 0 for none."""
    ends = lambda kind: [(e.a, e.b) for e in netlist.of(kind)]  # noqa: E731
    resistors = [(e.a, e.b, 1.0 / e.value) for e in netlist.of("R")]
    ports = _ports(netlist, r_on, g_leak, resistors)
    blocking = np.array([port.blocking for port in ports])
    scale = np.array([port.scale for port in ports])
    held = ends("C") + ends("V") + [p.ends for p in ports if p.blocking]
    driven = ends("L") + ends("I") + [p.ends for p in ports if not p.blocking]
    every = [*held, *driven, *((a, b) for a, b, _ in resistors)]
    nodes = tuple(dict.fromkeys(node for pair in every for node in pair if node != GROUND))

    T, N = _groups(nodes, held)
    roots = np.sqrt([g for *_, g in resistors])[:, None]
    branches = roots * _incidence(nodes, [(a, b) for a, b, _ in resistors]).T
    A_i = _incidence(nodes, driven)
    Q, R = np.linalg.qr(branches @ N)
    W = Q.T @ branches @ T
    Z = branches @ T - Q @ W
    U = np.linalg.solve(R.T, N.T @ A_i)
    K = T.T @ A_i - W.T @ U
    answers = np.block([[-Z.T @ Z, -K], [K.T, -U.T @ U]])
    z = np.linalg.solve(R, -np.hstack([W, U]))
    voltages = np.hstack([T, np.zeros_like(A_i)]) + N @ z

    # Branches come as C, V, blocking diodes, L, I, conducting diodes.
    c, l, p = len(ends("C")), len(ends("L")), len(held)
    v, i, t = len(ends("V")), len(ends("I")), int(blocking.sum())
    states = [*range(c), *range(p, p + l)]
    sources = [*range(c, c + v), *range(p + l, p + l + i)]
    own = np.empty(len(ports), int)
    own[blocking], own[~blocking] = (
        np.arange(c + v, c + v + t),
        np.arange(p + l + i, p + len(driven)),
    )
    # A diode blocks where a branch has a negative voltage.
    answers[:, own] *= np.where(blocking, -1.0, scale)
    voltages[:, own] *= np.where(blocking, -1.0, scale)
    storage = np.array([e.value for kind in "CL" for e in netlist.of(kind)])
    rates = answers[states] / storage[:, None]
    law = np.where(blocking, 1.0, -scale)[:, None] * answers[own]
    law[:, own] += np.diag([port.own for port in ports])
    return Equations(
        A=rates[:, states], B=rates[:, own], b=rates[:, sources],
        C=law[:, states], D=law[:, own], e=law[:, sources],
        V=voltages[:, states + sources + list(own)], storage=storage, blocking=blocking, nodes=nodes,
    )  # fmt: skip


def _ports(
    netlist: Netlist, r_on: float, g_leak: float, resistors: list[tuple[str, str, float]]
) -> list[_Port]:
    """The diodes as branches; what of them is a resistor joins the `resistors`."""
    groups = Groups()
    for e in netlist.elements:
        if e.kind in "RVC":
            groups.join(e.a, e.b)
    ports = []
    for e in netlist.of("D"):
        r = r_on if e.series is None else e.series
        g = g_leak if e.leak is None else e.leak
        if g > 0 and groups.join(e.a, e.b):
            inside = f"{e.name}:inside" if r else e.a
            if r:
                resistors.append((e.a, inside, 1.0 / r))
            ports.append(_Port((inside, e.b), True, 1.0, g))
        else:
            s = 1.0 / (1.0 + g * r)
            if g:
                resistors.append((e.a, e.b, g * s))
            ports.append(_Port((e.a, e.b), False, s, s * r))
    return ports


def _incidence(nodes: tuple[str, ...], branches: list[Branch]) -> Matrix:
    """1 where a branch leaves a node and −1 where it arrives, ground left out."""
    found = np.zeros((len(nodes), len(branches)))
    for k, (a, b) in enumerate(branches):
        for node, sign in ((a, 1.0), (b, -1.0)):
            if node != GROUND:
                found[nodes.index(node), k] += sign
    return found


def _groups(nodes: tuple[str, ...], held: list[Branch]) -> tuple[Matrix, Matrix]:
    """T and N: along a forest of branches of known voltage, each node's voltage as that of its group's
    first node plus voltages of branches."""
    T, N = np.zeros((len(nodes), len(held))), []
    eye = np.eye(len(held))
    seen: set[str] = set()
    for root in (GROUND, *nodes):
        if root in seen:
            continue
        group, waiting = np.zeros(len(nodes)), [(root, np.zeros(len(held)))]
        while waiting:
            node, sums = waiting.pop()
            seen.add(node)
            if node != GROUND:
                group[nodes.index(node)] = 1.0
                T[nodes.index(node)] = sums
            for k, (a, b) in enumerate(held):
                for here, there, sign in ((a, b, -1.0), (b, a, 1.0)):
                    if here == node and there not in seen:
                        waiting.append((there, sums + sign * eye[k]))
        if root != GROUND:
            N.append(group)
    return T, np.array(N).reshape(len(N), len(nodes)).T
