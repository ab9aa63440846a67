"""The compiled program that solves some members of an ensemble.

On a processor it solves them one after the other, each in its own loop, and several threads run it at
once: no member waits for another one, and a branch of a step costs only the members that take it. A
vectorised loop makes as many steps as its slowest member needs, with all branches.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax

from .. import _tree
from .._tree import Tree
from ..evolution import RESULTS
from ..evolution.arguments import Arguments
from ..evolution.closures import closure_convert
from ..evolution.integrate import integrate
from ..evolution.results import has_failed
from ..evolution.signature import Signature, flatten
from ..evolution.solve import arranged
from .inputs import Inputs


class Static(NamedTuple):
    """The options that the program is compiled for; `lanes` members advance together."""

    measure: bool | None
    max_steps: int
    adjoint: str
    max_events: int
    watch_stiffness: bool
    observe: Callable[[Any], Tree]
    lanes: int


class Row(NamedTuple):
    """What a member leaves: the observed values, its result, whether it failed, the time that it
    reached, and its numbers of accepted and rejected steps."""

    observed: Tree
    result: RESULTS
    failed: Any
    t: Any
    steps: Any
    rejected: Any


class Program(NamedTuple):
    """The program for members of these inputs: `shared` are all its numbers, of which those at `places`
    are replaced by the ones of a member."""

    shared: list[Any]
    places: tuple[int, ...]
    signature: Signature

    @staticmethod
    def of(
        code: tuple[Any, ...], inputs: Inputs, numbers: dict[str, Any], static: Static
    ) -> "Program":
        """Return the program; `code`: problem, method, solver of the law, events and constants;
        `numbers`: those of the options that are given."""
        data = inputs.member(0), numbers
        shared, signature = flatten(code, data, static)
        first = len(shared) - len(inputs.leaves) - len(numbers)
        places = tuple(first + k for k, own in enumerate(inputs.own) if own)
        for place in places:
            shared[place] = None
        return Program(shared, places, signature)

    def on(self, device: Any) -> "Program":
        """Return the program with its numbers on a device."""
        return self._replace(shared=jax.device_put(self.shared, device))

    def run(self, rows: list[Any]) -> Row:
        """Return the rows of the members with these leaves."""
        return _compiled(self.shared, rows, self.places, self.signature)

    def traced(self, rows: list[Any]) -> Row:
        """Return the same where leaves, or what the code closes over, are traced."""
        reverse = self.signature.options.adjoint == "reverse"
        solved = _solved_and_differentiated if reverse else _solved
        return solved(self.shared, rows, self.places, self.signature)


def _solved(shared: list[Any], rows: list[Any], places: Any, signature: Signature) -> Row:
    one, lanes = partial(_of_row, shared, places, signature), signature.options.lanes
    return lax.map(one, rows, batch_size=lanes if lanes > 1 else None)


_compiled = partial(jax.jit, static_argnums=(2, 3))(_solved)


def _solved_and_differentiated(
    shared: list[Any], rows: list[Any], places: Any, signature: Signature
) -> Row:
    """Return the same, with derivatives in reverse mode that solve a member again, rather than to store
    the steps of all, and that leave out members on which nothing depends: NaN derivatives of a failed
    one would make those in a shared parameter NaN."""
    example = jtu.tree_map(lambda leaf: leaf[0], rows)
    one, consts = jax.closure_convert(partial(_of_row, shared, places, signature), example)

    @jax.custom_vjp
    def isolated(row: list[Any], consts: list[Any]) -> Row:
        return one(row, *consts)

    def pull_back(given: tuple[list[Any], list[Any]], cotangent: Row) -> Any:
        real = [leaf for leaf in jtu.tree_leaves(cotangent) if leaf.dtype != jax.dtypes.float0]
        depends = jnp.any(jnp.stack([jnp.any(leaf != 0) for leaf in real]))
        found = jax.vjp(lambda row, consts: one(row, *consts), *given)[1](cotangent)
        kept = lambda leaf: (  # noqa: E731
            leaf if leaf.dtype == jax.dtypes.float0 else jnp.where(depends, leaf, 0.0)
        )
        return jtu.tree_map(kept, found)

    isolated.defvjp(lambda row, consts: (isolated(row, consts), (row, consts)), pull_back)
    return lax.map(lambda row: isolated(row, consts), rows)


def _of_row(shared: list[Any], places: Any, signature: Signature, row: list[Any]) -> Row:
    numbers = list(shared)
    for place, value in zip(places, row, strict=True):
        numbers[place] = value
    return _member(numbers, signature)


def _member(numbers: list[Any], signature: Signature) -> Row:
    """Solve one member."""
    code, data = signature.unflatten(numbers)
    problem, method, vi_solver, events, constants = code
    (x0, args, t0, t1, ts), given = data
    static: Static = signature.options
    stiff_steps = given.pop("stiff_steps")
    call = Arguments(
        problem, x0, t0, t1, args, method=method, vi_solver=vi_solver, constants=constants,
        measure=static.measure, max_steps=static.max_steps, adjoint=static.adjoint, events=events,
        max_events=static.max_events, **given,
    )  # fmt: skip
    setup, options = arranged(call, method)
    setup.setting["stiff_steps"] = stiff_steps
    options = options._replace(watch_stiffness=static.watch_stiffness)
    times = None if ts is None else jnp.asarray(ts, setup.dtype)
    solution, closes_over_traced = integrate(setup, times, options)
    if closes_over_traced:
        converted = closure_convert(problem, setup.number("t0"), x0, _tree.as_arrays(args))
        solution = eqx.tree_at(lambda s: s.setup, solution, setup._replace(problem=converted))
    stats = solution.stats
    return Row(
        static.observe(solution), solution.result, has_failed(solution.result, solution.ts),
        stats["t"], stats["steps"], stats["rejected"],
    )  # fmt: skip
