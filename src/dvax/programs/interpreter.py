"""The one interpreter of traced programs, for every kind of value that a program is read with.

A *domain* says what is known of a value in the place of an array: that it depends on y affinely, that
it lies between two arrays, how far rounding may have moved it. Its `rules` give, operation by
operation, what is known of the results. The interpreter walks the program, evaluates what the domain
has nothing to say about, enters inner programs (`jax.jit`, `jax.checkpoint`, functions with derivative
rules of their own), and hands an operation without a rule to `unknown`, which must assume the worst.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from .._jax.jaxprs import bind, inner_program, operation, read, scan_counts

Rule = Callable[..., Any]
"""From an equation and the values of its arguments to those of its results."""


def _apply(rule: Rule, eqn: Any, given: list[Any]) -> list[Any] | None:
    return rule(eqn, given)


class Domain(NamedTuple):
    """How a program is read.

    - `rules`: by the name of an operation (`dvax._jax.jaxprs.operation`);
    - `is_abstract`: whether a value is of the domain; an operation on other values alone is left to
      `evaluate`, which by default computes it;
    - `unknown`: the results of an operation without a rule and without an inner program;
    - `apply`: applies a rule; None means that the rule does not cover these arguments.
    """

    rules: Mapping[str, Rule]
    is_abstract: Callable[[Any], bool]
    unknown: Callable[[Any, list[Any]], list[Any]]
    apply: Callable[[Rule, Any, list[Any]], list[Any] | None] = _apply
    evaluate: Callable[[Any, list[Any]], list[Any]] = bind


def interpret(program: Any, inputs: list[Any], domain: Domain) -> list[Any]:
    """Return the values of the outputs of a program (a `ClosedJaxpr`), given those of its inputs."""
    jaxpr = program.jaxpr
    known = dict(zip(jaxpr.constvars, program.consts, strict=True))
    known |= dict(zip(jaxpr.invars, inputs, strict=True))
    for eqn in jaxpr.eqns:
        results = _operate(eqn, read(known, eqn.invars), domain)
        known.update(zip(eqn.outvars, results, strict=True))
    return read(known, jaxpr.outvars)


def _operate(eqn: Any, given: list[Any], domain: Domain) -> list[Any]:
    if not any(map(domain.is_abstract, given)):
        return domain.evaluate(eqn, given)
    rule = domain.rules.get(operation(eqn))
    results = None if rule is None else domain.apply(rule, eqn, given)
    if results is not None:
        return results
    inner = inner_program(eqn)
    return domain.unknown(eqn, given) if inner is None else interpret(inner, given, domain)


def entered(eqn: Any, given: list[Any], domain: Domain) -> list[Any] | None:
    """Return the results of a call by its inner program; None where it has none."""
    inner = inner_program(eqn)
    return None if inner is None else interpret(inner, given, domain)


MOST_TURNS = 32
"""The most turns of a loop that is unrolled."""


def unrolled(
    eqn: Any, given: list[Any], domain: Domain, row: Callable[..., Any], stack: Callable[..., Any]
) -> list[Any] | None:
    """Return the results of a loop of few turns (`lax.scan`, `fori_loop` between fixed numbers), turn
    by turn; None for a loop of many turns.

    `row(value, k)` is the k-th row of an array, `stack(values)` an array of such rows.
    """
    length, counts = eqn.params["length"], scan_counts(eqn.params)
    if not 0 < length <= MOST_TURNS or counts is None:
        return None
    first, second = counts[0], sum(counts)
    fixed, carry, arrays = given[:first], given[first:second], given[second:]
    rows: list[list[Any]] = [[] for _ in range(length)]
    for k in reversed(range(length)) if eqn.params["reverse"] else range(length):
        turn = [*fixed, *carry, *(row(v, k) for v in arrays)]
        out = interpret(eqn.params["jaxpr"], turn, domain)
        carry, rows[k] = out[: len(carry)], out[len(carry) :]
    return [*carry, *(stack(list(each)) for each in zip(*rows, strict=True))]


def same_for(names: Any, rule: Rule) -> dict[str, Rule]:
    """Return one rule for several operations."""
    return dict.fromkeys(names, rule)


def is_real(array: Any) -> bool:
    """Whether an array, or a variable's type, holds floating numbers."""
    return jnp.issubdtype(array.dtype, jnp.floating)
