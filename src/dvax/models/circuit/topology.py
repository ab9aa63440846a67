"""What the graph of a circuit must be for its equations to have one solution.

With capacitors as voltage sources and inductors and ideal diodes as current sources, the resistive
network that is left has one solution for all values of them if and only if

- no loop consists of voltage sources and capacitors alone, whose voltages would add up to zero;
- no set of current sources, inductors and diodes cuts off a part of the circuit: their currents would
  add up to zero (Chua and Lin 1975, Chapter 8).

Then every capacitor voltage and inductor current is a state, and the state is minimal.
"""

from ...errors import InputProblem, Problems
from ...formats.netlist import GROUND, Element, Netlist


def check(netlist: Netlist, leaks: bool) -> None:
    """Raise an `InputError` with everything that is wrong; `leaks` says that every diode leaks."""
    wrong = Problems(_missing(netlist))
    if not wrong:
        wrong += _floating(netlist)
    if not wrong:
        wrong += _loops(netlist) + _cuts(netlist, leaks)
    wrong.raise_any()


class Groups:
    """Nodes, and which of them are joined."""

    def __init__(self) -> None:
        self._above: dict[str, str] = {}

    def of(self, node: str) -> str:
        while node in self._above:
            node = self._above[node]
        return node

    def join(self, a: str, b: str) -> bool:
        """Whether they were apart."""
        a, b = self.of(a), self.of(b)
        if a != b:
            # Ground stands for its own group.
            a, b = (b, a) if b == GROUND else (a, b)
            self._above[b] = a
        return a != b


def _missing(netlist: Netlist) -> list[InputProblem]:
    nodes = {node for e in netlist.elements for node in (e.a, e.b)}
    wants = [
        (GROUND in nodes, "no node 0", "voltages are against node 0, the ground",
         "Call one of the nodes 0"),
        (bool(netlist.of("C") or netlist.of("L")), "no capacitor and no inductor",
         "without them nothing goes on in time", "Add one, such as C1 a 0 1u"),
        (bool(netlist.of("D")), "no diode", "without one the system is linear and has no law",
         "Add one, such as D1 a 0 R=1"),
    ]  # fmt: skip
    return [
        InputProblem(netlist.name, given, rule, fix)
        for holds, given, rule, fix in wants
        if not holds
    ]


def _floating(netlist: Netlist) -> list[InputProblem]:
    """Nodes that one element touches, and parts of the circuit that nothing joins to ground."""
    touching: dict[str, list[Element]] = {}
    groups = Groups()
    for e in netlist.elements:
        groups.join(e.a, e.b)
        for node in (e.a, e.b):
            touching.setdefault(node, []).append(e)
    wrong = Problems(
        InputProblem(
            netlist.place(own[0]), f"node {node}",
            f"it floats: {own[0].name} alone touches it, so no current can flow there",
            "Fix the name of the node, or drop the element",
        )
        for node, own in touching.items() if len(own) == 1 and node != GROUND
    )  # fmt: skip
    islands: dict[str, list[str]] = {}
    for node in touching:
        if groups.of(node) != GROUND:
            islands.setdefault(groups.of(node), []).append(node)
    for nodes in islands.values():
        wrong.add(
            netlist.place(touching[nodes[0]][0]), _listed("node", nodes),
            "nothing joins it to node 0, so its voltage is anything" if len(nodes) == 1
            else "nothing joins them to node 0, so their voltages are anything",
            "Join them to ground, by a large resistor where nothing else does",
        )  # fmt: skip
    return wrong


def _loops(netlist: Netlist) -> list[InputProblem]:
    """Loops of voltage sources and capacitors."""
    groups, kept, wrong = Groups(), [], Problems()
    for e in netlist.elements:
        if e.kind not in "VC":
            continue
        if groups.join(e.a, e.b):
            kept.append(e)
            continue
        loop = [*_path(kept, e.a, e.b), e]
        wrong.add(
            netlist.place(e), _listed("", [x.name for x in loop]),
            "voltage sources and capacitors close a loop, in which their voltages add up to zero: "
            "the current in it has no equation",
            "Put a resistor into the loop, or make one capacitor of those in parallel",
        )  # fmt: skip
    return wrong


def _path(edges: list[Element], start: str, end: str) -> list[Element]:
    """The edges of a forest from one node to another."""
    ways: dict[str, list[Element]] = {start: []}
    waiting = [start]
    while waiting:
        node = waiting.pop()
        for e in edges:
            if node in (e.a, e.b):
                other = e.b if node == e.a else e.a
                if other not in ways:
                    ways[other] = [*ways[node], e]
                    waiting.append(other)
    return ways[end]


def _cuts(netlist: Netlist, leaks: bool) -> list[InputProblem]:
    """Parts that current sources, inductors and diodes alone join to the rest."""
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
    # The same elements may cut off two parts from each other, with ground in neither.
    cuts = {tuple(e.line for e in cut): (part, cut) for part, cut in reversed(parts.items())}
    return [_cut(netlist, part, cut) for part, cut in reversed(cuts.values())]


def _cut(netlist: Netlist, part: str, cut: list[Element]) -> InputProblem:
    diodes = [e for e in cut if e.kind == "D"]
    names = _listed("", [e.name for e in cut])
    if not diodes:
        return InputProblem(
            netlist.place(*cut), names,
            f"inductors and current sources cut off the part with node {part}, so their currents add "
            "up to zero and are not free", "Put a resistor beside one of them",
        )  # fmt: skip
    which = _listed("", [e.name for e in diodes])
    return InputProblem(
        netlist.place(*diodes), which,
        f"nothing but {names} joins the part with node {part} to the rest: where no diode conducts, "
        "its voltage is anything, so the law has no modulus γ > 0",
        f"Give {'each of ' if len(diodes) > 1 else ''}{which} a leak, G=1n, or regularise all: "
        "r_on = 0.1 and g_leak = 1e-9",
    )  # fmt: skip


def _listed(noun: str, names: list[str]) -> str:
    if noun:
        noun = f"{noun} " if len(names) == 1 else f"{noun}s "
    return noun + ", ".join(names)
