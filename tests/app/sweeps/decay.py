"""A configuration for sweeps: x' = -rate x + growth x² + u, u = push, x(0) = 1, and its solution.

With growth = 0 it is x(t) = e^{-rate t} + push (1 - e^{-rate t})/rate; with growth > rate and no push x
is infinite at a finite time.
"""

import numpy as np

END = 1.0

MODEL = """
from typing import Annotated
import dvax


def f(t, x, u, args):
    return -args["rate"] * x + args["growth"] * x**2 + u


problem = dvax.Problem(
    A=dvax.generators.Scalar(0.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 10.0),
    f=f, h=lambda t, x, u, args: args["push"],
)


def build(
    rate: Annotated[float, "1/s"] = 1.0, push: Annotated[float, "mm/s"] = 0.0, growth: float = 0.0
):
    if rate == 13.0:
        raise ValueError("this rate has no model")
    args = dict(rate=rate, push=push, growth=growth)
    return dvax.models.Model(
        problem, 1.0, 1.0, args=args, states={"depth": "mm"}, responses={"force": "mm/s"}, title="decay"
    )
"""
CONFIG = '[model]\npython = "decay.py:build"\nframes = 4\nmethod = "ETD2RK"\ndt = 0.001\n'


def written(folder, sweep, config=CONFIG, model=MODEL):
    """Write the configuration, and a sweep of it. Returns the file of the sweep."""
    folder.mkdir(exist_ok=True, parents=True)
    (folder / "decay.py").write_text(model)
    (folder / "decay.toml").write_text(config)
    file = folder / "sweep.toml"
    file.write_text('config = "decay.toml"\n' + sweep)
    return file


def depth(t, rate, push):
    """x(t) with growth = 0."""
    gone = np.exp(-rate * t)
    return gone + push * (1 - gone) / rate
