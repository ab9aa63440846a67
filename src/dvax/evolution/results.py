"""The results of a solve: success and the kinds of failure."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


class RESULTS(eqx.Enumeration):
    """The result of a solve, described in a sentence.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> sol = dvax.solve(problem, -1.0, 0.0, 2.0)
    >>> sol.result == dvax.RESULTS.successful
    Array(True, dtype=bool)
    >>> print(dvax.RESULTS[sol.result])
    The end time was reached.

    ```
    """

    successful = "The end time was reached."
    terminal_event = "A terminal event ended the run."
    event_nonfinite = "The function or the reset of an event returned NaN or infinity."
    max_events = "More than max_events events happened, or they accumulate at one time."
    max_steps = "The largest number of steps was reached before t1."
    step_too_small = (
        "The step became too small to move t, or to lower its error, while the defect stayed above "
        "the tolerance."
    )
    picard_unconverged = (
        "Picard's sweeps did not converge on the shortest window, or the law was not solved there. "
        "Shorten dt, or use fewer nodes: dvax.Picard(nodes=16)."
    )
    implicit_unsolved = (
        "The equations of the shortest implicit step were not solved. f, h or K may be NaN or "
        "infinite there, or jump; else pass dvax.Implicit(solver) a solver with another root finder."
    )
    switching_unresolved = (
        "The constraints changed repeatedly at one time, and no mode is consistent after it. Check "
        "that the law is strongly pseudomonotone (dvax.verify), or use dvax.ExpRosenbrock()."
    )
    stiff = (
        "Stability limits the steps of the method, and not accuracy: dvax.ExpRosenbrock() may take "
        "longer ones."
    )
    nonfinite = "f, h or K returned NaN or infinity."
    law_unsolved = "The frozen law was not solved to its tolerance."
    invalid_number = (
        "A traced number breaks a rule: t0 < t1, no saved time before t0; dt, dt0, dt_max and horizon "
        "positive; rtol and atol not negative, and one of them positive."
    )


def is_success(result: RESULTS) -> Any:
    """Return whether a run reached its end: t1, or a terminal event."""
    return (result == RESULTS.successful) | (result == RESULTS.terminal_event)


def has_failed(result: RESULTS, ts: jax.Array) -> jax.Array:
    """Return whether a run failed, or missed one of its saved times `ts` before a terminal event."""
    ended = result == RESULTS.terminal_event
    return ~is_success(result) | ~(ended | jnp.all(ts < jnp.inf))


def result_names() -> list[str]:
    """Return the names of all results, sorted."""
    return sorted(RESULTS._name_to_item)
