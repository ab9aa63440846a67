"""Checks that the graph of a circuit admits a unique solution of its equations.

With capacitors as voltage sources and inductors and ideal diodes as current sources, the remaining
resistive network has a unique solution for all source values if and only if

- no loop consists only of voltage sources and capacitors, whose voltages would add up to zero;
- no cut consists only of current sources, inductors and diodes, whose currents would add up to zero
  (Chua and Lin 1975, Chapter 8).

Then every capacitor voltage and inductor current is a state, and the state is minimal.
"""

from ...errors import InputProblem, Problems
from ...formats.netlist import GROUND, Element, Netlist


def check(netlist: Netlist, leaks: bool) -> None:
    """Raise an `InputError` with all problems; with `leaks`, every diode has a leakage conductance."""
    wrong = Problems(_missing(netlist))
    if not wrong:
        wrong += _floating(netlist)
    if not wrong:
        wrong += _loops(netlist) + _cuts(netlist, leaks)
    wrong.raise_any()


class Groups:
    """A union-find structure of nodes."""

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}

    def of(self, node: str) -> str:
        """Return the representative of the node's group."""
        while node in self._parent:
            node = self._parent[node]
        return node

    def join(self, a: str, b: str) -> bool:
        """Merge the groups of a and b; return whether they were different."""
        a, b = self.of(a), self.of(b)
        if a != b:
            # Ground is the representative of its group.
            a, b = (b, a) if b == GROUND else (a, b)
            self._parent[b] = a
        return a != b


def _missing(netlist: Netlist) -> list[InputProblem]:
    nodes = {node for e in netlist.elements for node in (e.a, e.b)}
    requirements = [
        (GROUND in nodes, "no node 0", "voltages are relative to node 0, the ground",
         "Name one of the nodes 0"),
        (bool(netlist.of("C") or netlist.of("L")), "no capacitor and no inductor",
         "without them the circuit has no state", "Add one, such as C1 a 0 1u"),
        (bool(netlist.of("D")), "no diode", "without one the system is linear and has no law",
         "Add one, such as D1 a 0 R=1"),
    ]  # fmt: skip
    return [
        InputProblem(netlist.name, given, rule, fix)
        for holds, given, rule, fix in requirements
        if not holds
    ]


def _floating(netlist: Netlist) -> list[InputProblem]:
    """Return the nodes with a single element, and the parts of the circuit not connected to ground."""
    touching: dict[str, list[Element]] = {}
    groups = Groups()
    for e in netlist.elements:
        groups.join(e.a, e.b)
        for node in (e.a, e.b):
            touching.setdefault(node, []).append(e)
    wrong = Problems(
        InputProblem(
            netlist.place(elements[0]), f"node {node}",
            f"it floats: only {elements[0].name} is connected to it, so no current can flow there",
            "Correct the name of the node, or remove the element",
        )
        for node, elements in touching.items() if len(elements) == 1 and node != GROUND
    )  # fmt: skip
    islands: dict[str, list[str]] = {}
    for node in touching:
        if groups.of(node) != GROUND:
            islands.setdefault(groups.of(node), []).append(node)
    for nodes in islands.values():
        wrong.add(
            netlist.place(touching[nodes[0]][0]), _listed("node", nodes),
            "it is not connected to node 0, so its voltage is undetermined" if len(nodes) == 1
            else "they are not connected to node 0, so their voltages are undetermined",
            "Connect them to ground, for example by a large resistor",
        )  # fmt: skip
    return wrong


def _loops(netlist: Netlist) -> list[InputProblem]:
    """Return the loops of voltage sources and capacitors."""
    groups, forest, wrong = Groups(), [], Problems()
    for e in netlist.elements:
        if e.kind not in "VC":
            continue
        if groups.join(e.a, e.b):
            forest.append(e)
            continue
        loop = [*_path(forest, e.a, e.b), e]
        wrong.add(
            netlist.place(e), _listed("", [x.name for x in loop]),
            "voltage sources and capacitors form a loop, in which their voltages add up to zero: "
            "the current in it is undetermined",
            "Add a resistor to the loop, or combine parallel capacitors",
        )  # fmt: skip
    return wrong


def _path(edges: list[Element], start: str, end: str) -> list[Element]:
    """Return the edges of a forest from one node to another."""
    paths: dict[str, list[Element]] = {start: []}
    stack = [start]
    while stack:
        node = stack.pop()
        for e in edges:
            if node in (e.a, e.b):
                other = e.b if node == e.a else e.a
                if other not in paths:
                    paths[other] = [*paths[node], e]
                    stack.append(other)
    return paths[end]


def _cuts(netlist: Netlist, leaks: bool) -> list[InputProblem]:
    """Return the cuts of current sources, inductors and diodes."""
    groups = Groups()
    for e in netlist.elements:
        if e.kind in "RVC" or (e.kind == "D" and (leaks or e.leak is not None)):
            groups.join(e.a, e.b)
    parts: dict[str, list[Element]] = {}
    for e in netlist.elements:
        ends = groups.of(e.a), groups.of(e.b)
        if ends[0] != ends[1]:
            for part in set(ends) - {GROUND}:
                parts.setdefault(part, []).append(e)
    # The same elements may separate two parts, neither of which contains ground; report them once.
    cuts = {tuple(e.line for e in cut): (part, cut) for part, cut in reversed(parts.items())}
    return [_cut_problem(netlist, part, cut) for part, cut in reversed(cuts.values())]


def _cut_problem(netlist: Netlist, part: str, cut: list[Element]) -> InputProblem:
    diodes = [e for e in cut if e.kind == "D"]
    names = _listed("", [e.name for e in cut])
    if not diodes:
        return InputProblem(
            netlist.place(*cut), names,
            f"only inductors and current sources connect the part with node {part}, so their currents "
            "add up to zero and are not independent", "Add a resistor in parallel to one of them",
        )  # fmt: skip
    which = _listed("", [e.name for e in diodes])
    return InputProblem(
        netlist.place(*diodes), which,
        f"only {names} connects the part with node {part} to the rest: if no diode conducts, its "
        "voltage is undetermined, so the law has no modulus γ > 0",
        f"Give {'each of ' if len(diodes) > 1 else ''}{which} a leakage conductance, G=1n, or "
        "regularise all diodes: r_on = 0.1 and g_leak = 1e-9",
    )  # fmt: skip


def _listed(noun: str, names: list[str]) -> str:
    if noun:
        noun = f"{noun} " if len(names) == 1 else f"{noun}s "
    return noun + ", ".join(names)
