"""A small valid configuration of the contact law with its data, and ways to make it invalid."""

from pathlib import Path

TOML = """
[units]
time = "s"
length = "mm"
indentation = "um"
pressure = "MPa"

[model]
alpha = 1.5
beta = "0.5 MPa/um"
b_x = 1.0
b_u = 0.5
d_x = 0.2
d_u = 0.6
kappa0 = "0.8 MPa"

[boundary]
length = 10.0
points = 24

[demand]
expression = "2 + 1.5*sin(2*pi*s/10)"

[load]
series = { file = "load.csv", column = "rate", kind = "linear" }

[initial]
profile = { file = "x0.npy" }

[time]
end = 1.0
frames = 8

[solver]
dt = 0.05
"""
CSV = "time [s],rate [um/s]\n0.0,0.0\n0.4,3.0\n0.7,-2.0\n1.2,1.0\n"


def write_config(folder: Path, *changes: tuple[str, str], csv: str = CSV, x0: int = 24) -> Path:
    """Write configuration and data into `folder`, with each (old, new) text replaced."""
    import numpy as np

    folder.mkdir(parents=True, exist_ok=True)
    text = TOML
    for old, new in changes:
        assert text.count(old) == 1, f"{old!r} must occur once"
        text = text.replace(old, new)
    (folder / "load.csv").write_text(csv, encoding="utf-8")
    np.save(folder / "x0.npy", np.linspace(0.0, 1.0, x0))
    config = folder / "strip.toml"
    config.write_text(text, encoding="utf-8")
    return config
