"""Netlists of rectifiers with many diodes, also used by the tests of circuits."""


def multiplier(
    stages: int, r: float, capacity: float, frequency: float, volts: float, load: float,
    leak: float | None = None, source: float | None = None,
) -> str:  # fmt: skip
    """Return the netlist of Cockcroft and Walton's multiplier of voltage: two columns of capacitors (F)
    and diodes of resistance r (Ω) between them, with a `leak` (S) or none; `source` is the resistance
    of the source, whose amplitude is `volts`."""
    beside = f" G={leak:g}" if leak else ""
    lines = [f"V1 s 0 SIN(0 {volts:g} {frequency:g})"]
    lines += [f"R0 s a0 {source:g}"] if source else []
    nodes = ["a0" if source else "s", "0"]
    for k in range(1, stages + 1):
        lines += [
            f"C{2 * k - 1} {nodes[0]} a{k} {capacity:g}", f"C{2 * k} {nodes[1]} b{k} {capacity:g}",
            f"D{2 * k - 1} {nodes[1]} a{k} R={r:g}{beside}", f"D{2 * k} a{k} b{k} R={r:g}{beside}",
        ]  # fmt: skip
        nodes = [f"a{k}", f"b{k}"]
    return "\n".join([*lines, f"R9 b{stages} 0 {load:g}"]) + "\n"


def three_phases(
    r: float, frequency: float, line: float, stray: float, inductance: float, load: float
) -> str:
    """Return the netlist of a bridge of six diodes of resistance r (Ω) behind three lines of inductance
    `line` (H), with `stray` capacities (F) at their ends where not 0, and a filter."""
    lines = []
    for k, phase in enumerate("abc", 1):
        lines += [
            f"V{k} s{phase} 0 SIN(0 325 {frequency:g} 0 0 {-120 * (k - 1)})",
            f"L{k} s{phase} {phase} {line:g}", f"R{k} s{phase} {phase} 1k",
            f"D{2 * k - 1} {phase} p R={r:g} G=1u", f"D{2 * k} n {phase} R={r:g} G=1u",
        ]  # fmt: skip
        lines += [f"C{k} {phase} 0 {stray:g}"] if stray else []
    return "\n".join([*lines, f"L9 p q {inductance:g}", f"R9 q n {load:g}", "C9 q n 100u"]) + "\n"
