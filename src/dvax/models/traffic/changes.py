"""What changes with time: capacities by incidents, demand by a factor."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ... import _tree
from ...errors import InputError, Problems, input_error
from ...formats.road_network import Network
from ...sets import Simplex
from ...signals import AbstractSignal, Constant, Function, Table


class Incident(NamedTuple):
    """The link from node `link[0]` to node `link[1]` has the share `remaining` of its capacity for
    start ≤ t < end.

    Incidents on one link at one time multiply. A share is positive: nobody knows what a closed link
    costs, and a network without it is another network.

    ```python
    >>> from dvax.models.traffic import Incident
    >>> Incident(link=(10, 16), remaining=0.3, start=20.0, end=25.0).remaining
    0.3

    ```
    """

    link: tuple[int, int]
    remaining: float
    start: float
    end: float


class _Cut(eqx.Module):
    """The capacities at a time."""

    base: jax.Array
    links: jax.Array
    remaining: jax.Array
    start: jax.Array
    end: jax.Array

    def __call__(self, t: Any) -> jax.Array:
        now = (self.start <= t) & (t < self.end)
        share = jnp.where(now, self.remaining, jnp.ones_like(self.remaining))
        return self.base.at[self.links].multiply(share)


class _Demand(eqx.Module):
    """K(t): the path flows of every pair are ≥ 0 and sum up to d(t) = factor(t)·trips."""

    factor: AbstractSignal
    most: jax.Array
    base: jax.Array
    simplices: Simplex

    def __call__(self, t: Any, args: Any) -> Simplex:
        factor = self.factor(t)
        # Bounds hold up to `most`; NaN stops a run that goes beyond, but for the rounding of a signal.
        room = self.most * (1 + 16 * jnp.finfo(self.most.dtype).eps)
        held = jnp.where((factor >= 0) & (factor <= room), factor, jnp.nan)
        return eqx.tree_at(lambda K: K.total, self.simplices, held * self.base)


def capacities(
    network: Network, incidents: Sequence[Incident]
) -> tuple[AbstractSignal, np.ndarray]:
    """The capacities as a function of time, and all values that they take, one a row.

    **Raises:** `dvax.InputError` for every incident on a link that is not there, with a share outside
    (0, 1], or without a duration.
    """
    base = network.capacity
    if not incidents:
        return Constant(jnp.asarray(base)), base[None]
    problems = Problems()
    links = []
    for k, incident in enumerate(incidents):
        one = f"incidents[{k}]"
        try:
            links.append(network.link(*incident.link))
        except InputError as error:
            place = f"dvax.models.Traffic({one}.link)"
            problems += [
                replace(p, place=place, given=f"{p.place}: {p.given}") for p in error.problems
            ]
        if not 0 < incident.remaining <= 1:
            problems.add(
                f"dvax.models.Traffic({one}.remaining)", f"remaining = {incident.remaining}",
                "it is the share of the capacity that is left, in (0, 1]",
                "Take a small share for a closed link, or remove the link",
            )  # fmt: skip
        if not -np.inf < incident.start < incident.end < np.inf:
            problems.add(
                f"dvax.models.Traffic({one}.start, {one}.end)",
                f"start = {incident.start}, end = {incident.end}",
                "it begins before it ends", "Fix the times",
            )  # fmt: skip
    problems.raise_any()
    remaining, start, end = (
        np.array([getattr(i, name) for i in incidents], float)
        for name in ("remaining", "start", "end")
    )
    cut = _Cut(
        jnp.asarray(base), jnp.asarray(np.array(links), jnp.int32), jnp.asarray(remaining),
        jnp.asarray(start), jnp.asarray(end),
    )  # fmt: skip
    times = np.unique(np.concatenate([start, end]))
    values = [base]
    for t in times:
        now = base.copy()
        np.multiply.at(now, np.array(links), np.where((start <= t) & (t < end), remaining, 1.0))
        values.append(now)
    return Function(cut, knots=times), np.unique(np.stack(values), axis=0)


def demand_set(
    trips: np.ndarray, sizes: np.ndarray, factor: AbstractSignal | None, most: np.ndarray
) -> Any:
    """K: a set where the demand rests, else a callable (t, args)."""
    simplices = Simplex(jnp.asarray(trips), sizes=sizes)
    if factor is None:
        return simplices
    return _Demand(factor, jnp.asarray(most), jnp.asarray(trips), simplices)


def demand_factor(given: Any, peak: Any, pairs: int) -> tuple[AbstractSignal | None, np.ndarray]:
    """The factor as a signal, None where it is 1, and the most that it comes to, a number a pair.

    **Raises:** `dvax.InputError` where it is neither a signal nor callable, has values of a wrong
    shape or below 0, or its peak is not known.
    """
    name = "dvax.models.Traffic(demand)"
    if given is None and peak is None:
        return None, np.ones(())
    signal: Any = given
    if not isinstance(given, AbstractSignal):
        if not callable(given):
            raise _wrong(
                name, repr(given), "it is a signal or a callable of t, the factor of all trips",
                "Give dvax.signals.Table(times, factors), say",
            )  # fmt: skip
        signal = Function(given)
    known = None
    if isinstance(signal, Constant):
        known = np.asarray(signal.constant)[None]
    elif isinstance(signal, Table) and signal.kind != "cubic":
        known = np.asarray(signal.values)
    if known is not None and np.any(known < 0):
        raise _wrong(
            name, f"a factor of {known.min():g}", "there are no negative trips", "Fix the factors"
        )
    if peak is None:
        if known is None:
            raise _wrong(
                "dvax.models.Traffic(peak)", "None",
                f"the largest value of a {type(signal).__name__} cannot be read off it, and the "
                "bounds on flows rest on it",
                "Give peak=, a number that the factor never exceeds",
            )  # fmt: skip
        peak = known.max(axis=0)
    most = np.asarray(peak, float)
    shape = jax.eval_shape(signal.value, 0.0).shape if known is None else known.shape[1:]
    for what, found in (("demand", shape), ("peak", most.shape)):
        if found not in ((), (pairs,)):
            raise _wrong(
                f"dvax.models.Traffic({what})", f"values of shape {found}",
                f"it is one factor, or one for each of the {pairs} pairs", "Give it that shape",
            )  # fmt: skip
    if not np.all((most > 0) & np.isfinite(most)):
        raise _wrong(
            "dvax.models.Traffic(peak)", _tree.short(most), "without trips nothing is to be solved",
            "Give a positive number",
        )  # fmt: skip
    return signal, most


def _wrong(place: str, given: str, rule: str, fix: str) -> InputError:
    return input_error(place, given, rule, fix)
