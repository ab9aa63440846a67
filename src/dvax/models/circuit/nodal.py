"""Assembly of the circuit equations by nodal analysis.

Capacitors are voltage sources and inductors are current sources. The ideal part of each diode is a
source of its unknown y: the current through it, or, for as many diodes as are needed to connect all
parts of the circuit, the voltage that it blocks (a proper tree: Chua and Lin 1975, Chapter 8). The
remaining network is resistive. The voltages of nodes that are connected by voltage branches differ by
the branch voltages e, so the node voltages are v = Te + Nz, with one unknown z for each group of such
nodes without ground. With the conductances g and the incidence matrices A_r and A_i of resistors and
of current branches i, Kirchhoff's law Nᵀ(A_r g A_rᵀ v + A_i i) = 0 determines z, and the currents
through the voltage branches are j = −Tᵀ(A_r g A_rᵀ v + A_i i). With the factors √g A_rᵀ N = QR and

    Z = (1 − QQᵀ)√g A_rᵀ T,   W = Qᵀ√g A_rᵀ T,   U = R⁻ᵀNᵀA_i,   K = TᵀA_i − WᵀU,

    j = −ZᵀZ e − K i,   A_iᵀv = Kᵀe − UᵀU i.

ZᵀZ and UᵀU are positive semidefinite and the coupling is exactly skew-symmetric, so the circuit is
passive in floating-point arithmetic as well. R is invertible if there is no forbidden loop or cut
(`topology`).

A diode with unknown current y, series resistance r and parallel conductance g is equivalent to a
conductance gs parallel to a current source sy, s = 1/(1 + gr), and its ideal part blocks s(ry − v_D).
A diode with unknown blocked voltage y conducts j + gy, and r is one of the resistors.
"""

from typing import NamedTuple

import numpy as np

from ...formats.netlist import GROUND, Netlist
from .topology import Groups

Matrix = np.ndarray
Branch = tuple[str, str]


class Equations(NamedTuple):
    """x' = Ax + By + b s,   w = Dy + Cx + e s,   0 ≤ y ⟂ w ≥ 0,   v = V (x, s, y).

    `blocking` marks the diodes whose y is the blocked voltage and whose w is the current; for the
    others it is the reverse. `storage` holds C (farad) and L (henry) of the states: the energy is
    ½ Σ storage x². `V` maps (x, s, y) to the voltages of the `nodes`.
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
    """A diode: the ends of its branch, s, and its term in the diagonal of D, sr or g."""

    ends: Branch
    blocking: bool
    scale: float
    diagonal: float


def assemble(netlist: Netlist, r_on: float, g_leak: float) -> Equations:
    """Return the equations; diodes without R= have `r_on`, and those without G= have `g_leak`."""

    def ends(kind: str) -> list[Branch]:
        return [(e.a, e.b) for e in netlist.of(kind)]

    resistors = [(e.a, e.b, 1.0 / e.value) for e in netlist.of("R")]
    ports = _ports(netlist, r_on, g_leak, resistors)
    blocking = np.array([port.blocking for port in ports])
    scale = np.array([port.scale for port in ports])
    voltage_branches = ends("C") + ends("V") + [p.ends for p in ports if p.blocking]
    current_branches = ends("L") + ends("I") + [p.ends for p in ports if not p.blocking]
    every = [*voltage_branches, *current_branches, *((a, b) for a, b, _ in resistors)]
    nodes = tuple(dict.fromkeys(node for pair in every for node in pair if node != GROUND))

    T, N = _node_groups(nodes, voltage_branches)
    roots = np.sqrt([g for *_, g in resistors])[:, None]
    branches = roots * _incidence(nodes, [(a, b) for a, b, _ in resistors]).T
    A_i = _incidence(nodes, current_branches)
    Q, R = np.linalg.qr(branches @ N)
    W = Q.T @ branches @ T
    Z = branches @ T - Q @ W
    U = np.linalg.solve(R.T, N.T @ A_i)
    K = T.T @ A_i - W.T @ U
    responses = np.block([[-Z.T @ Z, -K], [K.T, -U.T @ U]])
    z = np.linalg.solve(R, -np.hstack([W, U]))
    voltages = np.hstack([T, np.zeros_like(A_i)]) + N @ z

    # The branches are ordered as C, V, blocking diodes, L, I, conducting diodes.
    c, l, p = len(ends("C")), len(ends("L")), len(voltage_branches)
    v, i, t = len(ends("V")), len(ends("I")), int(blocking.sum())
    states = [*range(c), *range(p, p + l)]
    sources = [*range(c, c + v), *range(p + l, p + l + i)]
    diodes = np.empty(len(ports), int)
    diodes[blocking], diodes[~blocking] = (
        np.arange(c + v, c + v + t),
        np.arange(p + l + i, p + len(current_branches)),
    )
    # The blocked voltage of a diode is minus its branch voltage.
    responses[:, diodes] *= np.where(blocking, -1.0, scale)
    voltages[:, diodes] *= np.where(blocking, -1.0, scale)
    storage = np.array([e.value for kind in "CL" for e in netlist.of(kind)])
    rates = responses[states] / storage[:, None]
    law = np.where(blocking, 1.0, -scale)[:, None] * responses[diodes]
    law[:, diodes] += np.diag([port.diagonal for port in ports])
    return Equations(
        A=rates[:, states], B=rates[:, diodes], b=rates[:, sources],
        C=law[:, states], D=law[:, diodes], e=law[:, sources],
        V=voltages[:, states + sources + list(diodes)],
        storage=storage, blocking=blocking, nodes=nodes,
    )  # fmt: skip


def _ports(
    netlist: Netlist, r_on: float, g_leak: float, resistors: list[tuple[str, str, float]]
) -> list[_Port]:
    """Return the diodes as branches, and append their resistances to `resistors`."""
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
    """Return the incidence matrix without ground: 1 at the start of a branch, −1 at its end."""
    matrix = np.zeros((len(nodes), len(branches)))
    for k, (a, b) in enumerate(branches):
        for node, sign in ((a, 1.0), (b, -1.0)):
            if node != GROUND:
                matrix[nodes.index(node), k] += sign
    return matrix


def _node_groups(nodes: tuple[str, ...], branches: list[Branch]) -> tuple[Matrix, Matrix]:
    """Return T and N of v = Te + Nz.

    Along a spanning forest of the voltage branches, the voltage of each node is that of the first node
    of its group plus the voltages of branches.
    """
    T, N = np.zeros((len(nodes), len(branches))), []
    eye = np.eye(len(branches))
    visited: set[str] = set()
    for root in (GROUND, *nodes):
        if root in visited:
            continue
        group, stack = np.zeros(len(nodes)), [(root, np.zeros(len(branches)))]
        while stack:
            node, sums = stack.pop()
            visited.add(node)
            if node != GROUND:
                group[nodes.index(node)] = 1.0
                T[nodes.index(node)] = sums
            for k, (a, b) in enumerate(branches):
                for start, end, sign in ((a, b, -1.0), (b, a, 1.0)):
                    if start == node and end not in visited:
                        stack.append((end, sums + sign * eye[k]))
        if root != GROUND:
            N.append(group)
    return T, np.array(N).reshape(len(N), len(nodes)).T
