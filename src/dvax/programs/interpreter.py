"""The abstract interpreter of traced programs, common to all domains.

A *domain* replaces arrays by abstract values: "depends on y affinely", "lies between two arrays", "has
at most this rounding error". Its `rules` map the abstract values of the arguments of an operation to
those of its results. The interpreter evaluates operations on concrete values, enters inner programs
(`jax.jit`, `jax.checkpoint`, functions with custom derivative rules), and passes an operation without a
rule to `unknown`, which must make no assumption about it.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from .._jax.jaxprs import applies_function, bind, inner_program, read, scan_counts
from .._jax.known_functions import operation

Rule = Callable[..., Any]
"""A function of an equation and the values of its arguments that returns the values of its results."""


def _apply(rule: Rule, eqn: Any, operands: list[Any]) -> list[Any] | None:
    return rule(eqn, operands)


class Domain(NamedTuple):
    """An abstract domain.

    - `rules`: the rules by the names of operations (`dvax._jax.known_functions.operation`);
    - `is_abstract`: returns whether a value belongs to the domain;
    - `unknown`: returns the results of an operation without a rule and without an inner program;
    - `apply`: applies a rule, and returns None if the rule does not cover these arguments;
    - `evaluate`: returns the results of an operation without abstract arguments; by default it computes
      them.
    """

    rules: Mapping[str, Rule]
    is_abstract: Callable[[Any], bool]
    unknown: Callable[[Any, list[Any]], list[Any]]
    apply: Callable[[Rule, Any, list[Any]], list[Any] | None] = _apply
    evaluate: Callable[[Any, list[Any]], list[Any]] = bind


def interpret(program: Any, inputs: list[Any], domain: Domain) -> list[Any]:
    """Return the values of the outputs of a program (a `ClosedJaxpr`), given those of its inputs."""
    jaxpr = program.jaxpr
    environment = dict(zip(jaxpr.constvars, program.consts, strict=True))
    environment |= dict(zip(jaxpr.invars, inputs, strict=True))
    for eqn in jaxpr.eqns:
        results = operate(eqn, read(environment, eqn.invars), domain)
        environment.update(zip(eqn.outvars, results, strict=True))
    return read(environment, jaxpr.outvars)


def operate(eqn: Any, operands: list[Any], domain: Domain) -> list[Any]:
    """Return the values of the results of one operation."""
    if not any(map(domain.is_abstract, operands)):
        return domain.evaluate(eqn, operands)
    rule = None
    if not applies_function(eqn):
        rule = domain.rules.get(operation(eqn)) or domain.rules.get(eqn.primitive.name)
    results = None if rule is None else domain.apply(rule, eqn, operands)
    if results is not None:
        return results
    inner = inner_program(eqn)
    return domain.unknown(eqn, operands) if inner is None else interpret(inner, operands, domain)


def entered(eqn: Any, operands: list[Any], domain: Domain) -> list[Any] | None:
    """Return the results of a call by its inner program; None where it has none."""
    inner = inner_program(eqn)
    return None if inner is None else interpret(inner, operands, domain)


MAX_UNROLLED = 32
"""Largest number of iterations of a loop that is unrolled."""


def unroll(
    eqn: Any,
    operands: list[Any],
    run: Callable[[Any, list[Any]], list[Any]],
    row: Callable[..., Any],
    stack: Callable[..., Any],
) -> list[Any] | None:
    """Return the results of a `lax.scan`, unrolled, or None if it has more than `MAX_UNROLLED`
    iterations. (A `fori_loop` with static bounds is a scan.)

    `run(program, inputs)` interprets its program, `row(value, k)` returns the k-th row of an array, and
    `stack(values)` an array of rows.
    """
    length, counts = eqn.params["length"], scan_counts(eqn.params)
    if not 0 < length <= MAX_UNROLLED or counts is None:
        return None
    first, second = counts[0], sum(counts)
    constants, carry, arrays = operands[:first], operands[first:second], operands[second:]
    rows: list[list[Any]] = [[] for _ in range(length)]
    for k in reversed(range(length)) if eqn.params["reverse"] else range(length):
        turn = [*constants, *carry, *(row(v, k) for v in arrays)]
        out = run(eqn.params["jaxpr"], turn)
        carry, rows[k] = out[: len(carry)], out[len(carry) :]
    return [*carry, *(stack(list(each)) for each in zip(*rows, strict=True))]


def same_for(names: Any, rule: Rule) -> dict[str, Rule]:
    """Return one rule for several operations."""
    return dict.fromkeys(names, rule)


def is_real(array: Any) -> bool:
    """Return whether an array, or the type of a variable, is floating-point."""
    return jnp.issubdtype(array.dtype, jnp.floating)
