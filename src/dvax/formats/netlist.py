"""The text of a circuit: one element a line, as in SPICE.

    R1 a b 1k               resistor
    L1 a b 10m IC=0.1       inductor, with the current from a to b at t = 0
    C1 a b 1u  IC=10        capacitor, with the voltage of a over b at t = 0
    V1 a b SIN(0 10 1k)     voltage of a over b: a number, DC number, SIN, PWL or PULSE(...)
    I1 a b 1m               current that flows from a through the source to b
    D1 a b R=1 G=1n         ideal diode from anode a to cathode b, in series with a resistance R,
                            its ideal part beside a conductance G (both may be left out)

Node 0 is ground. What follows a ``;``, and lines that begin with ``*`` or ``#``, are comments; there is
no title line. Numbers have engineering suffixes (f p n u m k Meg G T) and may have units.
"""

import re
from dataclasses import dataclass

from ..errors import Problems, input_error
from ..signals import AbstractSignal
from .netlist_sources import read_waveform
from .netlist_values import read_value

GROUND = "0"

_QUANTITY = {
    "R": "resistance",
    "L": "inductance",
    "C": "capacitance",
    "V": "voltage",
    "I": "current",
}
_WORDS = {
    "R": {}, "L": {"IC": "current"}, "C": {"IC": "voltage"}, "V": {}, "I": {},
    "D": {"R": "resistance", "G": "conductance"},
}  # fmt: skip
"""The words with a value that an element may have."""


@dataclass(frozen=True)
class Element:
    """One line: `kind` is the first letter of the `name`; current counts from node `a` to node `b`.

    `value` of R, L and C in SI units; `initial` of L and C; `source` of V and I; `series` resistance
    and `leak` conductance of D, None where the line has none.
    """

    kind: str
    name: str
    a: str
    b: str
    line: int
    value: float = 0.0
    initial: float = 0.0
    source: AbstractSignal | None = None
    series: float | None = None
    leak: float | None = None


@dataclass(frozen=True)
class Netlist:
    """The elements in the order of the file, and its `name` in messages.

    ```python
    >>> from dvax.formats import read_netlist
    >>> net = read_netlist("C1 out 0 1u", name="half.cir")
    >>> net.name, [element.name for element in net.elements]
    ('half.cir', ['C1'])

    ```
    """

    name: str
    elements: tuple[Element, ...]

    def of(self, kind: str) -> list[Element]:
        """All elements of a kind."""
        return [element for element in self.elements if element.kind == kind]

    def place(self, *elements: Element) -> str:
        """Where elements are written."""
        lines = [str(element.line) for element in elements]
        if len(lines) == 1:
            return f"{self.name}, line {lines[0]}"
        return f"{self.name}, lines {', '.join(lines[:-1])} and {lines[-1]}"


def read_netlist(text: str, name: str = "netlist") -> Netlist:
    """Read the elements of a netlist; `name` stands for it in messages.

    **Raises:** `dvax.InputError` with the line of everything that is wrong: unknown elements, missing
    nodes, malformed numbers, wrong units, names used twice.

    ```python
    >>> from dvax.formats import read_netlist
    >>> net = read_netlist("C1 out 0 1u IC=10  ; ten volts at first")
    >>> net.elements[0].name, net.elements[0].initial
    ('C1', 10.0)

    ```
    """
    elements: list[Element] = []
    wrong = Problems()
    lines: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = _words(line)
        if not words:
            continue
        place = f"{name}, line {number}"
        first = lines.setdefault(words[0].upper(), number)
        if first != number:
            wrong.add(
                place, words[0], f"line {first} has this name already, and names are told apart "
                "without regard to case", "Rename one of them",
            )  # fmt: skip
        with wrong.collect():
            elements.append(_element(words, place, number))
    wrong.raise_any()
    return Netlist(name, tuple(elements))


def _words(line: str) -> list[str]:
    """The words of a line, SIN(...) being one; none for a comment."""
    line = line.split(";")[0].strip()
    if line.startswith(("*", "#")) or line.lower() == ".end":
        return []
    line = "=".join(part.strip() for part in line.split("="))
    return re.findall(r"[A-Za-z]+\s*\([^)]*\)?|\S+", line)


def _element(words: list[str], place: str, line: int) -> Element:
    name = words[0]
    kind = name[0].upper()
    if kind not in _WORDS:
        raise input_error(
            place, name, "elements begin with R, L, C, V, I or D, and there are no commands and no "
            "title", "Put a * before a comment",
        )  # fmt: skip
    rest = [word for word in words[1:] if not re.match(r"[A-Za-z]+=", word)]
    named = [word for word in words[1:] if re.match(r"[A-Za-z]+=", word)]
    least = 2 if kind == "D" else 3
    if len(rest) < least:
        missing = "a node" if len(rest) < 2 else "its value"
        raise input_error(
            place, " ".join(words), f"{missing} is missing: an element has a name, two nodes"
            + ("" if kind == "D" else " and a value"), f"Write {_example(kind)}",
        )  # fmt: skip
    a, b = rest[:2]
    wrong = Problems()
    if a == b:
        wrong.add(
            place, f"{name} from {a} to {b}", "both ends are one node, so it does nothing there",
            "Fix a node, or drop the element",
        )  # fmt: skip
    found: dict[str, float] = {}
    source = None
    with wrong.collect():
        if kind in "VI":
            source = read_waveform(rest[2:], _QUANTITY[kind], place)
        elif len(rest) > least:
            why = f"{name} has two nodes" + ("" if kind == "D" else " and one value")
            if kind == "D":
                why += ", and no models of diodes are known"
            raise input_error(place, " ".join(rest[least:]), why, f"Write {_example(kind)}")
        elif kind != "D":
            found["value"] = _positive(rest[2], _QUANTITY[kind], place)
    said: dict[str, str] = {}
    for word in named:
        with wrong.collect():
            key, value = _named(kind, word, place)
            first = said.setdefault(key, word)
            if first is not word:
                raise input_error(
                    place, f"{first} and {word}",
                    "a word stands once, or it is not known which of them counts",
                    "Keep one of them",
                )  # fmt: skip
            found[key] = value
    wrong.raise_any()
    return Element(kind, name, a, b, line, source=source, **found)


def _named(kind: str, word: str, place: str) -> tuple[str, float]:
    key, _, text = word.partition("=")
    quantity = _WORDS[kind].get(key.upper())
    if quantity is None:
        known = " and ".join(f"{k}=" for k in _WORDS[kind]) or "none"
        raise input_error(place, word, f"the words of an element {kind} are {known}", "Drop it")
    if kind == "D":
        return {"R": "series", "G": "leak"}[key.upper()], _positive(text, quantity, place)
    return "initial", read_value(text, quantity, place)


def _positive(text: str, quantity: str, place: str) -> float:
    value = read_value(text, quantity, place)
    if value <= 0:
        raise input_error(
            place, repr(text), f"the {quantity} is positive: energy comes from V and I alone",
            "Fix the value, or drop the element",
        )  # fmt: skip
    return value


def _example(kind: str) -> str:
    return {
        "R": "R1 a b 1k", "L": "L1 a b 10m", "C": "C1 a b 1u", "V": "V1 a b 10", "I": "I1 a b 1m",
        "D": "D1 anode cathode R=1",
    }[kind]  # fmt: skip
