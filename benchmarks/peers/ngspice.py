"""ngspice as a process a run: a netlist in, times, voltages and the seconds of its analysis out."""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

_DIODE = "sd"


class Run(NamedTuple):
    """Accepted times (s), the outputs there, and the seconds that ngspice reports for its analysis."""

    ts: np.ndarray
    values: np.ndarray
    seconds: float


def found() -> bool:
    """Whether ngspice is on the PATH."""
    return shutil.which("ngspice") is not None


def translate(netlist: str, r: float, g: float) -> str:
    """Return a netlist of dvax in the syntax of ngspice.

    Diodes are the code model `sidiode`: two straight lines, of the resistances r and r + 1/g. A jump of
    the source of the converter becomes a ramp of 1 ps.
    """
    lines = []
    for line in netlist.strip().splitlines():
        words = line.split(";")[0].split()
        if words[0][0] == "D":
            words = ["A" + words[0], *words[1:3], _DIODE]
        lines.append(" ".join(words))
    model = f".model {_DIODE} sidiode(Ron={r:.17g} Roff={r + 1.0 / g:.17g})"
    text = "\n".join([*lines, model])
    return text.replace("PULSE(-12 12 0 0 0 4u 10u)", "PULSE(-12 12 0 1p 1p 3.999999u 10u)")


def simulate(
    netlist: str,
    end: float,
    outputs: str,
    *,
    longest: float | None = None,
    reltol: float = 1e-3,
    timeout: float = 300.0,
) -> Run:
    """Run a transient analysis from the initial values of the netlist to `end` (s).

    `outputs` are what ngspice writes, such as v(a). Without `longest` the longest step is what ngspice
    takes by itself, end/50.

    **Raises:** `RuntimeError` with what ngspice printed if it does not reach the end.
    """
    step = (
        f"{longest:.17g} {end:.17g} 0 {longest:.17g}" if longest else f"{end / 50:.17g} {end:.17g}"
    )
    with tempfile.TemporaryDirectory() as folder:
        deck, file = Path(folder) / "deck.cir", Path(folder) / "out.txt"
        deck.write_text(
            f"circuit\n{netlist}\n.options reltol={reltol:g}\n.control\nset numdgt=15\n"
            f"tran {step} uic\nwrdata {file} {outputs}\nrusage everything\nquit\n.endc\n.end\n",
            encoding="utf-8",
        )
        answer = subprocess.run(
            ["ngspice", "-b", str(deck)],
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
        )
        printed = answer.stdout + answer.stderr
        seconds = re.search(r"Transient analysis time = ([\d.e+-]+)", printed)
        data = np.loadtxt(file) if file.exists() else np.zeros((0, 2))
        if seconds is None or not len(data) or data[-1, 0] < 0.999999 * end:
            raise RuntimeError(f"ngspice did not reach the end. {printed[-2000:]}")
        return Run(data[:, 0], data[:, 1::2], float(seconds[1]))
