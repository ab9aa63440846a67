"""An independent analysis of circuits, equation by equation, and random circuits for it."""

from typing import NamedTuple

import numpy as np

Array = np.ndarray


class Tableau(NamedTuple):
    """x' = Ax + By + b s, w = Dy + Cx + e s with y the currents of all ideal diodes."""

    A: Array
    B: Array
    b: Array
    C: Array
    D: Array
    e: Array
    blocking: tuple[bool, ...]


def tableau(text: str) -> Tableau:
    """Every node voltage and every branch current is an unknown; every branch has an equation. Numbers
    are plain decimal ones here; sources are named by their order, and what they do does not matter."""
    branches: list[tuple[str, str, str, float]] = []
    for line in filter(None, map(str.strip, text.splitlines())):
        name, a, b, *rest = line.split()
        kind = name[0]
        if kind == "D":
            r, g = (float(word.split("=")[1]) for word in rest)
            branches += [("R", a, name, r), ("D", name, b, 0.0), ("R", name, b, 1.0 / g)]
        else:
            branches.append((kind, a, b, float(rest[0])))
    nodes = sorted({n for _, a, b, _ in branches for n in (a, b)} - {"0"})
    n, m = len(nodes), len(branches)
    place = {node: k for k, node in enumerate(nodes)}
    of = {kind: [k for k, row in enumerate(branches) if row[0] == kind] for kind in "RLCVID"}
    given = [*of["C"], *of["L"], *of["V"], *of["I"], *of["D"]]
    system, right = np.zeros((n + m, n + m)), np.zeros((n + m, len(given)))
    for k, (kind, a, b, value) in enumerate(branches):
        across = np.zeros(n + m)
        for node, sign in ((a, 1.0), (b, -1.0)):
            if node != "0":
                system[place[node], n + k] += sign
                across[place[node]] += sign
        if kind in "RCV":
            system[n + k] = across
        if kind == "R":
            system[n + k, n + k] = -value
        if kind in "LID":
            system[n + k, n + k] = 1.0
        if kind != "R":
            right[n + k, given.index(k)] = 1.0
    solved = np.linalg.solve(system, right)

    def voltage(k: int) -> Array:
        _, a, b, _ = branches[k]
        zero = np.zeros(len(given))
        return (solved[place[a]] if a != "0" else zero) - (solved[place[b]] if b != "0" else zero)

    rates = np.array(
        [solved[n + k] / branches[k][3] for k in of["C"]]
        + [voltage(k) / branches[k][3] for k in of["L"]]
    )
    blocked = -np.array([voltage(k) for k in of["D"]])
    x, d = len(of["C"]) + len(of["L"]), len(of["D"])
    s = slice(x, len(given) - d)
    return Tableau(
        A=rates[:, :x], b=rates[:, s], B=rates[:, len(given) - d :],
        C=blocked[:, :x], e=blocked[:, s], D=blocked[:, len(given) - d :], blocking=(False,) * d,
    )  # fmt: skip


def random_netlist(rng: np.random.Generator, island: bool) -> str:
    """Some six nodes with all kinds of elements; with an `island` that diodes alone join to the rest.
    Capacitors and voltage sources make a forest, resistors join all that is not the island."""
    nodes = ["0", *(f"n{k}" for k in range(5))]
    size = lambda: f"{10 ** rng.uniform(-1, 1):.6f}"  # noqa: E731
    lines = [f"R{k} {a} {b} {size()}" for k, (a, b) in enumerate(zip(nodes, [*nodes[1:], "0"]))]
    order = list(rng.permutation(nodes))
    for k, kind in enumerate(rng.permutation(["C", "C", "V", "C"])):
        a, b = rng.permutation(order[k : k + 2])
        lines.append(f"{kind}{k} {a} {b} {size()}")
    for k, kind in enumerate("LLI"):
        a, b = rng.choice(nodes, 2, replace=False)
        lines.append(f"{kind}{k} {a} {b} {size()}")
    ends = [tuple(rng.choice(nodes, 2, replace=False)) for _ in range(2)]
    if island:
        lines.append(f"R9 p q {size()}")
        ends = [ends[0], (str(rng.choice(nodes)), "p"), ("q", str(rng.choice(nodes)))]
    lines += [f"D{k} {a} {b} R={size()} G={size()}" for k, (a, b) in enumerate(ends)]
    return "\n".join(lines)
