"""Road networks and trip tables, and the rules that they satisfy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import Problems, input_error

_FREE_NODES = 1000
"""The most nodes without a link: arrays have an entry for each node."""


@dataclass(frozen=True, eq=False)
class Network:
    """Nodes 1 … `nodes`, of which 1 … `zones` are where trips begin and end, and links between them.

    A link from `init_node` to `term_node` that carries the flow v takes the time

        t(v) = free_flow_time (1 + b (v/capacity)^power),        (BPR; 0⁰ = 1)

    constant where b, `power` or `free_flow_time` is 0. Nodes below `first_thru_node` may begin and
    end a path but not lie inside one.

    **Units:** flows and capacities in one unit (vehicles an hour, say), times in one unit of time;
    `length` and `toll` in any, made comparable by the weights of `Traffic`. `toll` may be None.

    **Raises:** `dvax.InputError` for every link that breaks a rule: a node that is not there, a
    capacity that is not positive, any other number that is negative, a link from a node to itself,
    a second link between the same two nodes.

    ```python
    >>> import numpy as np
    >>> from dvax.models.traffic import Network
    >>> two_roads = Network(zones=2, nodes=3, first_thru_node=3,
    ...                     init_node=[1, 1, 3], term_node=[2, 3, 2], capacity=[10.0, 20.0, 20.0],
    ...                     length=[5.0, 4.0, 4.0], free_flow_time=[5.0, 4.0, 4.0],
    ...                     b=[0.15, 0.15, 0.0], power=[4.0, 4.0, 4.0])
    >>> len(two_roads), two_roads.link(3, 2)
    (3, 2)

    ```
    """

    zones: int
    nodes: int
    first_thru_node: int
    init_node: Any
    term_node: Any
    capacity: Any
    length: Any
    free_flow_time: Any
    b: Any
    power: Any
    toll: Any = None
    name: str = "network"
    lines: Any = field(default=None, repr=False)

    def __post_init__(self) -> None:
        problems = _shaped(
            self, "Network", ("init_node", "term_node"),
            ("capacity", "length", "free_flow_time", "b", "power", "toll"),
        )  # fmt: skip
        if not problems:
            problems = self._problems()
        problems.raise_any()

    def __len__(self) -> int:
        """The number of links."""
        return len(self.init_node)

    def link(self, init_node: int, term_node: int) -> int:
        """The index of the link between two nodes. Raises `dvax.InputError` where there is none."""
        found = np.flatnonzero((self.init_node == init_node) & (self.term_node == term_node))
        if found.size == 0:
            leaving = self.term_node[self.init_node == init_node]
            raise input_error(
                f"the link from {init_node} to {term_node}",
                f"no such link in {self.name}",
                "a link is named by its first and its last node",
                f"Links from {init_node} go to {', '.join(map(str, leaving)) or 'no node'}",
            )
        return int(found[0])

    def place(self, index: Any) -> str:
        """Return the place of a link: its line, or its number."""
        if self.lines is None:
            return f"{self.name}, link {index + 1}"
        return f"{self.name}, line {self.lines[index]}"

    def _problems(self) -> Problems:
        """Return the problems of each link."""
        problems = Problems()
        if not 1 <= self.zones <= self.nodes:
            problems.add(
                self.name, f"{self.zones} zones and {self.nodes} nodes",
                "zones are the first ones of the nodes, so there are at most as many, and one at least",
                "Fix the counts",
            )  # fmt: skip
        if self.nodes > _FREE_NODES + 2 * len(self.init_node):
            problems.add(
                self.name, f"{self.nodes} nodes and {len(self.init_node)} links",
                "a node has a link, and a link has two nodes",
                "Fix the number of nodes, or add the links",
            )  # fmt: skip
        if not 1 <= self.first_thru_node <= self.nodes + 1:
            problems.add(
                self.name, f"first_thru_node = {self.first_thru_node}",
                f"it is a node, 1 to {self.nodes}: those below it are never passed through",
                "Write 1 where every node may be passed through",
            )  # fmt: skip
        for column in ("init_node", "term_node"):
            problems += _unknown(getattr(self, column), self.nodes, column, "node", self.place)
        rules = (
            ("capacity", True, "nothing goes through a link without one; remove a closed link"),
            ("length", False, "distances are not negative"),
            ("free_flow_time", False, "nothing arrives before it left"),
            ("b", False, "more flow would be faster, and the equilibrium not unique"),
            ("power", False, "more flow would be faster, and the equilibrium not unique"),
            ("toll", False, "a path could gain by going round in circles"),
        )
        for column, strictly, why in rules:
            values = getattr(self, column)
            if values is None:
                continue
            sound = (values > 0 if strictly else values >= 0) & np.isfinite(values)
            for i in np.flatnonzero(~sound):
                rule = "a positive number" if strictly else "a number ≥ 0"
                fix = f"Fix the {column}"
                if column == "capacity":
                    fix += "; a link whose time does not depend on its flow has b = 0"
                problems.add(self.place(i), f"{column} {values[i]:g}", f"it is {rule}: {why}", fix)
        for i in np.flatnonzero(self.init_node == self.term_node):
            problems.add(
                self.place(i), f"a link from node {self.init_node[i]} to itself",
                "it leads nowhere", "Remove it",
            )  # fmt: skip
        for i, first in _repeated(self.init_node, self.term_node):
            problems.add(
                self.place(i), f"a link from {self.init_node[i]} to {self.term_node[i]}",
                f"two nodes have one link a direction, and {self.place(first)} has this one",
                "Remove one, or put a node into the second road",
            )  # fmt: skip
        return problems


@dataclass(frozen=True, eq=False)
class Trips:
    """`flow` trips from each `origin` to each `destination`, both zones 1 … `zones`.

    Pairs without trips are left out. Trips within a zone use no link: they are left out, and
    `within` is what they sum up to.

    **Units:** trips in the unit of the capacities.

    **Raises:** `dvax.InputError` for every pair that breaks a rule: a zone that is not there, a
    negative flow, a pair that is given twice.

    ```python
    >>> from dvax.models.traffic import Trips
    >>> trips = Trips(zones=2, origin=[1, 1, 2], destination=[2, 1, 1], flow=[6.0, 2.0, 0.0])
    >>> len(trips), float(trips.flow.sum()), trips.within
    (1, 6.0, 2.0)

    ```
    """

    zones: int
    origin: Any
    destination: Any
    flow: Any
    name: str = "trips"
    lines: Any = field(default=None, repr=False)
    within: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        problems = _shaped(self, "Trips", ("origin", "destination"), ("flow",))
        if not problems:
            problems = self._problems()
        problems.raise_any()
        inside = self.origin == self.destination
        object.__setattr__(self, "within", float(self.flow[inside].sum()))
        kept = np.flatnonzero(~inside & (self.flow > 0))
        kept = kept[np.lexsort((self.destination[kept], self.origin[kept]))]
        for name in ("origin", "destination", "flow", "lines"):
            values = getattr(self, name)
            object.__setattr__(self, name, None if values is None else values[kept])

    def __len__(self) -> int:
        """The number of pairs with trips."""
        return len(self.flow)

    def place(self, index: Any) -> str:
        """Return the place of a pair: its line, or its number."""
        if self.lines is None:
            return f"{self.name}, pair {index + 1}"
        return f"{self.name}, line {self.lines[index]}"

    def _problems(self) -> Problems:
        """Return the problems of each pair."""
        problems = Problems()
        for column in ("origin", "destination"):
            problems += _unknown(getattr(self, column), self.zones, column, "zone", self.place)
        for i in np.flatnonzero(~((self.flow >= 0) & np.isfinite(self.flow))):
            pair = f"{self.origin[i]} to {self.destination[i]}"
            problems.add(
                self.place(i), f"{self.flow[i]:g} trips from {pair}", "trips are a number ≥ 0",
                "Fix the number",
            )  # fmt: skip
        for i, first in _repeated(self.origin, self.destination):
            problems.add(
                self.place(i), f"trips from {self.origin[i]} to {self.destination[i]} once more",
                f"a pair stands once, and {self.place(first)} has it", "Add the two up, or remove one",
            )  # fmt: skip
        return problems


def _unknown(
    values: np.ndarray, largest: int, column: str, kind: str, place: Callable[[Any], str]
) -> Problems:
    problems = Problems()
    fix = f"Fix the number, or the number of {kind}s"
    for i in np.flatnonzero((values < 1) | (values > largest)):
        problems.add(
            place(i), f"{column} {values[i]}", f"there are the {kind}s 1 to {largest}", fix
        )
    return problems


def _repeated(first: np.ndarray, second: np.ndarray) -> list[tuple[int, int]]:
    """Return (i, j) for every i whose pair occurs before, first at j."""
    seen: dict[tuple[int, int], int] = {}
    found = []
    for i, pair in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        if pair in seen:
            found.append((i, seen[pair]))
        else:
            seen[pair] = i
    return found


def _shaped(table: Any, title: str, whole: Sequence[str], real: Sequence[str]) -> Problems:
    """Convert the columns to arrays of one length; return the problems of those that cannot be."""
    problems, lengths = Problems(), {}
    for column in (*whole, *real):
        given = getattr(table, column)
        if given is None:
            continue
        values = np.asarray(given)
        kinds = "iu" if column in whole else "iuf"
        if values.ndim != 1 or values.dtype.kind not in kinds:
            what = "whole numbers" if column in whole else "real numbers"
            problems.add(
                f"dvax.models.{title}({column})", f"{values.dtype} of shape {values.shape}",
                f"it is a vector of {what}", "Give one for each",
            )  # fmt: skip
            continue
        values = values.astype(np.int64 if column in whole else np.float64)
        values.setflags(write=False)
        object.__setattr__(table, column, values)
        lengths[column] = len(values)
    if len(set(lengths.values())) > 1:
        problems.add(
            f"dvax.models.{title}",
            ", ".join(f"{count} {column}" for column, count in lengths.items()),
            "all columns have one length", "Give one entry for each",
        )  # fmt: skip
    return problems
