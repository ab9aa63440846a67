"""The communication between devices that a compiled program contains, read from its HLO text.

The text of a compiled program is for people, and XLA may change it. A collective operation is a line

    %name = f64[512]{0} all-gather(%operand), …, metadata={op_name="jit(run)/while/body/step/add"}

in the braces of its computation. Loops, branches and calls name the computations that they run.
"""

import math
import re
from collections.abc import Iterator
from typing import NamedTuple

KINDS = (
    "all-reduce",
    "all-gather",
    "all-to-all",
    "collective-permute",
    "reduce-scatter",
    "collective-broadcast",
    "ragged-all-to-all",
)

_BITS = {"pred": 8, "c64": 64, "c128": 128}
_OPENING = re.compile(r"^(ENTRY )?%?([\w.\-]+) .*\{$")
_LINE = re.compile(r"^\s*(?:ROOT )?%?[\w.\-]+ = (.*?) ([a-z][a-z0-9\-]*)\(")
_ARRAY = re.compile(r"\b([a-z]+\d*\w*)\[([\d,]*)\]")
_CALLED = re.compile(
    r"(?:body|condition|to_apply|calls|true_computation|false_computation)=%?([\w.\-]+)"
)
_BRANCHES = re.compile(r"branch_computations=\{([^}]*)\}")
_SCOPE = re.compile(r'op_name="([^"]*)"')


class Found(NamedTuple):
    """A collective operation: its kind, the bytes of its result on one device, whether it belongs to
    the loop over steps (`in_step`), and whether a branch or a loop within a step contains it, so that a
    step may run it never or more than once (`optional`)."""

    kind: str
    bytes: int
    in_step: bool
    optional: bool


def collectives(text: str, scope: str) -> list[Found]:
    """Return the collective operations of a compiled program. The loop over steps is the one whose body
    has operations in the named scope `scope`."""
    computations = _computations(text)
    entry = next(name for name, (is_entry, _) in computations.items() if is_entry)
    return list(_walk(computations, entry, scope, False, False))


def _computations(text: str) -> dict[str, tuple[bool, list[str]]]:
    """Return the lines of each computation, and whether it is the one that the program begins with."""
    found: dict[str, tuple[bool, list[str]]] = {}
    lines: list[str] = []
    for line in text.splitlines():
        opening = _OPENING.match(line)
        if opening and not line.startswith("HloModule"):
            lines = []
            found[opening[2]] = bool(opening[1]), lines
        else:
            lines.append(line)
    return found


def _walk(
    computations: dict[str, tuple[bool, list[str]]],
    name: str,
    scope: str,
    in_step: bool,
    optional: bool,
) -> Iterator[Found]:
    for line in computations[name][1]:
        parts = _LINE.match(line)
        if parts is None:
            continue
        result, kind = parts[1], parts[2].removesuffix("-start")
        if kind in KINDS:
            # The result of an asynchronous start repeats the operand.
            started = parts[2].endswith("-start") and kind != "all-reduce"
            yield Found(kind, _size(result) // (2 if started else 1), in_step, optional)
            continue
        called = _CALLED.findall(line)
        for branches in _BRANCHES.findall(line):
            called += [branch.strip().lstrip("%") for branch in branches.split(",")]
        for other in called:
            steps = in_step or (kind == "while" and _is_step(computations, other, scope))
            inner = in_step and kind in ("while", "conditional")
            yield from _walk(computations, other, scope, steps, optional or inner)


def _is_step(computations: dict[str, tuple[bool, list[str]]], name: str, scope: str) -> bool:
    """Return whether a computation is the body of the loop over steps: the innermost one with
    operations in the scope. (XLA moves those that do not vary to the loop around it.)"""
    lines = computations[name][1]
    bodies = [body for line in lines for body in re.findall(r"body=%?([\w.\-]+)", line)]
    return _is_in_scope(lines, scope) and not any(
        _is_in_scope(computations[body][1], scope) for body in bodies
    )


def _is_in_scope(lines: list[str], scope: str) -> bool:
    """Return whether one of the operations lies in the scope, and in no loop or branch within it."""
    for line in lines:
        names = _SCOPE.search(line)
        if names and scope in names[1]:
            inside = names[1].rsplit(scope, 1)[1]
            if "/while/" not in inside and "/cond/" not in inside:
                return True
    return False


def _size(shapes: str) -> int:
    """Return the bytes of an array, or of a tuple of arrays."""
    bits = 0
    for kind, sizes in _ARRAY.findall(shapes):
        width = _BITS.get(kind) or int(re.sub(r"\D", "", kind)[:2] or 0)
        bits += width * math.prod(int(n) for n in sizes.split(",") if n)
    return bits // 8
