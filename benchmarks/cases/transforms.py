"""Heat on a square by fast transforms: against SciPy's, and a step against the transforms in it."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft

import dvax
from dvax.generators.transforms import Transform

from ..clock import in_turn, spread, timed
from ..section import Section, Table, compare

_SIDE = 1024
_KINDS = {
    "dirichlet": (scipy.fft.dstn, scipy.fft.idstn),
    "neumann": (scipy.fft.dctn, scipy.fft.idctn),
}
_STEPS = 20
_CLOSE, _STEP = 2.0, 1.5


def run(full: bool) -> Section:
    side, rounds = (_SIDE, 15) if full else (_SIDE, 7)
    section = Section(
        title=f"transforms: {side} × {side} points",
        fair=(
            "SciPy's dctn and dstn of type 2 and their inverses on the same array with as many threads "
            "as the machine has cores; dvax's forward and backward transforms, which keep a grid of "
            "midpoints, under jax.jit. A step is the whole of ETD2RK with a pointwise law, in a run of "
            f"{_STEPS} fixed ones; beside it stand the transforms that it cannot avoid (of the two "
            "values of f̃, and two back: the coefficients of x₀ are those that it was made from), run "
            "alone in a loop of the same length."
        ),
    )
    x = np.random.default_rng(0).normal(size=(side, side))
    device = jnp.asarray(x)
    for kind, (there, back) in _KINDS.items():
        transform = Transform((side, side), (kind, kind))
        forward, backward = jax.jit(transform.forward), jax.jit(transform.backward)
        coefficients = forward(device)
        apart = float(jnp.max(jnp.abs(backward(coefficients) - device)))
        theirs = there(x, type=2, workers=-1)
        sides = {
            "forward": lambda f=forward: f(device).block_until_ready(),
            "backward": lambda b=backward, c=coefficients: b(c).block_until_ready(),
            "scipy forward": lambda t=there: t(x, type=2, workers=-1),
            "scipy backward": lambda b=back, c=theirs: b(c, type=2, workers=-1),
        }
        taken = in_turn({name: timed(side) for name, side in sides.items()}, rounds)
        for way in ("forward", "backward"):
            section.comparisons.append(
                compare(f"{kind}, {way}", "scipy.fft", taken[way], taken[f"scipy {way}"], error=apart,
                        target=("≤", _CLOSE))
            )  # fmt: skip
        _step(section, kind, side, device, rounds)
    return section


def _step(section: Section, kind: str, side: int, x0: jax.Array, rounds: int) -> None:
    problem = dvax.Problem(
        A=dvax.generators.Elliptic((side, side), 1.0, kind), P=dvax.operators.Scaling(1.0),
        K=dvax.sets.Box(0.0, 0.4), f=lambda t, x, u, args: 0.2 - u,
        h=lambda t, x, u, args: 1.0 - 1.5 * x - 0.5 * u,
    )  # fmt: skip
    transform = Transform((side, side), (kind, kind))
    whole = jax.jit(lambda x: dvax.solve(problem, x, 0.0, 1e-3, dt=1e-3 / _STEPS).xs[-1])

    def moves(_: int, v: jax.Array) -> jax.Array:
        first = transform.backward(1e-3 * transform.forward(v))
        return transform.backward(1e-3 * transform.forward(first))

    alone = jax.jit(lambda x: jax.lax.fori_loop(0, _STEPS, moves, x))
    sides = {"step": whole, "transforms": alone}
    taken = in_turn(
        {name: timed(lambda f=f: f(x0).block_until_ready()) for name, f in sides.items()}, rounds
    )
    section.comparisons.append(
        compare(f"{kind}, a step of ETD2RK", "its transforms alone", taken["step"],
                taken["transforms"], target=("≤", _STEP))
    )  # fmt: skip
    rows = [(name, f"{1e3 * spread(taken[name]).middle / _STEPS:.1f} ms") for name in taken]
    section.tables.append(Table(f"{kind}: a step", ("what", "time"), rows))
