"""Time-dependent data: capacities with incidents, and demand with a factor."""

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
    """A reduction of the capacity of a link for start ≤ t < end.

    The link from node `link[0]` to node `link[1]` has the fraction `remaining` > 0 of its capacity.
    The fractions of simultaneous incidents on one link multiply. A closed link has no finite cost;
    model it by a network without the link.

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


class _Capacity(eqx.Module):
    """The capacities as a function of time."""

    base: jax.Array
    links: jax.Array
    remaining: jax.Array
    start: jax.Array
    end: jax.Array

    def __call__(self, t: Any) -> jax.Array:
        active = (self.start <= t) & (t < self.end)
        fraction = jnp.where(active, self.remaining, jnp.ones_like(self.remaining))
        return self.base.at[self.links].multiply(fraction)


class _Demand(eqx.Module):
    """K(t): the path flows of every pair are ≥ 0 and add up to d(t) = factor(t)·trips."""

    factor: AbstractSignal
    most: jax.Array
    base: jax.Array
    simplices: Simplex

    def __call__(self, t: Any, args: Any) -> Simplex:
        factor = self.factor(t)
        # The constants are proved up to `most`; beyond it, except for roundoff, NaN stops the run.
        limit = self.most * (1 + 16 * jnp.finfo(self.most.dtype).eps)
        factor = jnp.where((factor >= 0) & (factor <= limit), factor, jnp.nan)
        return eqx.tree_at(lambda K: K.total, self.simplices, factor * self.base)


def capacities(
    network: Network, incidents: Sequence[Incident]
) -> tuple[AbstractSignal, np.ndarray]:
    """Return the capacities as a function of time, and all values that they take, one a row.

    **Raises:** `dvax.InputError` for every incident on a missing link, with a fraction outside (0, 1],
    or with start ≥ end.
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
                "it must be the remaining fraction of the capacity, in (0, 1]",
                "Use a small fraction for a closed link, or remove the link",
            )  # fmt: skip
        if not -np.inf < incident.start < incident.end < np.inf:
            problems.add(
                f"dvax.models.Traffic({one}.start, {one}.end)",
                f"start = {incident.start}, end = {incident.end}",
                "start < end must hold, and both be finite", "Correct the times",
            )  # fmt: skip
    problems.raise_any()
    remaining, start, end = (
        np.array([getattr(i, name) for i in incidents], float)
        for name in ("remaining", "start", "end")
    )
    capacity = _Capacity(
        jnp.asarray(base), jnp.asarray(np.array(links), jnp.int32), jnp.asarray(remaining),
        jnp.asarray(start), jnp.asarray(end),
    )  # fmt: skip
    times = np.unique(np.concatenate([start, end]))
    values = [base]
    for t in times:
        value = base.copy()
        np.multiply.at(value, np.array(links), np.where((start <= t) & (t < end), remaining, 1.0))
        values.append(value)
    return Function(capacity, knots=times), np.unique(np.stack(values), axis=0)


def demand_set(
    trips: np.ndarray, sizes: np.ndarray, factor: AbstractSignal | None, most: np.ndarray
) -> Any:
    """Return K: a set if the demand is constant, else a callable (t, args)."""
    simplices = Simplex(jnp.asarray(trips), sizes=sizes)
    if factor is None:
        return simplices
    return _Demand(factor, jnp.asarray(most), jnp.asarray(trips), simplices)


def demand_factor(given: Any, peak: Any, pairs: int) -> tuple[AbstractSignal | None, np.ndarray]:
    """Return the factor as a signal (None if it is 1), and its maximum for each pair.

    **Raises:** `dvax.InputError` if the factor is neither a signal nor callable, has values of a wrong
    shape or below 0, or its maximum is unknown.
    """
    name = "dvax.models.Traffic(demand)"
    if given is None and peak is None:
        return None, np.ones(())
    signal: Any = given
    if not isinstance(given, AbstractSignal):
        if not callable(given):
            raise input_error(
                name, repr(given), "it must be a signal or a callable of t, the factor of all trips",
                "Give a signal, such as dvax.signals.Table(times, factors)",
            )  # fmt: skip
        signal = Function(given)
    samples = None
    if isinstance(signal, Constant):
        samples = np.asarray(signal.constant)[None]
    elif isinstance(signal, Table) and signal.kind != "cubic":
        samples = np.asarray(signal.values)
    if samples is not None and np.any(samples < 0):
        raise input_error(
            name, f"a factor of {samples.min():g}", "factors must be ≥ 0", "Correct the factors"
        )
    if peak is None:
        if samples is None:
            raise input_error(
                "dvax.models.Traffic(peak)", "None",
                f"the maximum of a {type(signal).__name__} is unknown, and the bounds on flows "
                "depend on it",
                "Give peak=, a number that the factor never exceeds",
            )  # fmt: skip
        peak = samples.max(axis=0)
    most = np.asarray(peak, float)
    shape = jax.eval_shape(signal.value, 0.0).shape if samples is None else samples.shape[1:]
    for what, given_shape in (("demand", shape), ("peak", most.shape)):
        if given_shape not in ((), (pairs,)):
            raise input_error(
                f"dvax.models.Traffic({what})", f"values of shape {given_shape}",
                f"it must be one factor, or one for each of the {pairs} pairs",
                "Give it this shape",
            )  # fmt: skip
    if not np.all((most > 0) & np.isfinite(most)):
        raise input_error(
            "dvax.models.Traffic(peak)", _tree.short(most), "the maximum must be positive and finite",
            "Give a positive number",
        )  # fmt: skip
    return signal, most
