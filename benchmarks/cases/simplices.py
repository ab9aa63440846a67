"""Very many simplices of unequal size in one projection against a loop over them."""

import jax
import jax.numpy as jnp
import numpy as np

import dvax

from ..clock import in_turn, timed
from ..section import Section, compare

_COUNT = 10**5
_LEAST = 20.0


def run(full: bool) -> Section:
    rng = np.random.default_rng(0)
    sizes = rng.integers(2, 51, _COUNT)
    totals = rng.uniform(0.1, 5.0, _COUNT)
    z = rng.normal(size=sizes.sum())
    parts = np.split(z, np.cumsum(sizes)[:-1])

    K = dvax.sets.Simplex(jnp.asarray(totals), sizes=sizes)
    space = dvax.spaces.Euclidean(len(z))
    project = jax.jit(lambda K, z: K.project(z, space))
    point = jnp.asarray(z)

    def once() -> jax.Array:
        return project(K, point).block_until_ready()

    def loop() -> np.ndarray:
        return np.concatenate([_sorted(v, total) for v, total in zip(parts, totals)])

    def feasibility(p: np.ndarray) -> float:
        sums = np.add.reduceat(p, np.cumsum(sizes) - sizes)
        return float(max(np.max(np.abs(sums - totals)), np.max(-p)))

    ours, theirs = np.asarray(once()), loop()
    taken = in_turn(
        {"ours": timed(once), "loop": timed(loop)},
        9 if full else 5,
    )
    section = Section(
        title=f"simplices: {_COUNT:.0e} of mixed size 2 to 50, projected in one call",
        fair=(
            "The other side is a Python loop over the textbook's projection in NumPy (sort, cumulate, "
            "cut) for one simplex; cutting the vector is not timed. dvax projects all of them in "
            "one compiled call, the set being an argument of it. Errors: the worst of |Σ y − total| "
            "and of −y."
        ),
    )
    section.comparisons.append(
        compare(
            f"{_COUNT:.0e} simplices, {len(z):.1e} entries",
            "NumPy, a Python loop",
            taken["ours"],
            taken["loop"],
            direction="other/dvax",
            error=feasibility(ours),
            error_other=feasibility(theirs),
            target=("≥", _LEAST),
        )
    )
    section.notes.append(f"The two differ by at most {np.max(np.abs(ours - theirs)):.1e}.")
    section.notes.append(f"JAX runs on {jax.devices()[0].device_kind}.")
    return section


def _sorted(v: np.ndarray, total: float) -> np.ndarray:
    falling = np.sort(v)[::-1]
    above = np.cumsum(falling) - total
    last = np.nonzero(falling * np.arange(1, len(v) + 1) > above)[0][-1]
    return np.maximum(v - above[last] / (last + 1), 0.0)
