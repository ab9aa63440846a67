"""A small contact law whose data are formulas."""

from pathlib import Path

TOML = """
[units]
length = "mm"
indentation = "um"
pressure = "MPa"

[model]
alpha = 1.0
beta = 2.0
b_x = 0.8
b_u = 0.6
d_x = 0.3
d_u = 0.5
kappa0 = 1.5

[boundary]
length = 4.0
points = 12

[demand]
expression = "(1 + sin(2*pi*s/4)) * (1 - 0.4*exp(-t)) / (1 + 0.1*s)"

[load]
expression = "2*step(t)*cos(3*t)"
value = 1.5

[time]
end = 1.0
frames = 10

[solver]
dt = 0.05

[output]
report = false
"""


def write(folder: Path) -> Path:
    file = folder / "wave.toml"
    file.write_text(TOML, encoding="utf-8")
    return file
