"""Checks of the events of `dvax.solve`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import _tree, _user_code
from ..errors import Problems, input_error
from .closures import convert
from .event import Event
from .method import AbstractMethod
from .setup import Setup

_CALLER = "dvax.Event"


def check_events(events: Any, max_events: Any, method: Any, dt: Any, certified: bool) -> None:
    """Raise one `InputError` with everything that is wrong with the events of a solve."""
    wrong = Problems()

    def rule(holds: bool, name: str, given: Any, text: str, fix: str) -> None:
        if not holds:
            wrong.add(f"dvax.solve({name})", repr(given)[:120], text, fix)

    is_list = isinstance(events, list | tuple) and all(isinstance(e, Event) for e in events)
    rule(is_list, "events", events, "it must be a list of dvax.Event",
         "Write events=[dvax.Event(lambda t, x, u, args: …)]")  # fmt: skip
    is_integer = isinstance(max_events, int | np.integer) and not isinstance(max_events, bool)
    rule(bool(is_integer and max_events >= 1), "max_events", max_events,
         "it must be a positive whole number", "Omit it for 256")  # fmt: skip
    if is_list and events:
        rule(dt is None, "events, dt", dt, "events are located in adaptive steps", "Omit dt")
        rule(method is None or isinstance(method, AbstractMethod), "events, method", method,
             "events are located on the dense output of a step, which this method lacks",
             "Use dvax.DormandPrince() or an exponential method")  # fmt: skip
        stops = [k for k, event in enumerate(events) if event.stops]
        rule(not (certified and stops), "events, certified_tol", _tree.Text(f"event {stops}"),
             "a bound at all saved times holds for events that are only recorded",
             "Omit certified_tol, or terminal= and reset=")  # fmt: skip
    wrong.raise_any()


def checked_events(setup: Setup, args: Any) -> tuple[Event, ...]:
    """Return the events with their traced closure variables as leaves.

    **Raises:** `dvax.InputError` if a function returns no real number, or a reset no state.
    """
    if not setup.events:
        return ()
    t, x = setup.number("t0"), setup.x0
    u = setup.problem.zero_control(x)
    inputs = {"t": t, "x": x, "u": u, "args": args}
    return tuple(_checked(event, inputs) for event in setup.events)


def _checked(event: Event, inputs: dict[str, Any]) -> Event:
    x = inputs["x"]
    value = _shapes("function", event.function, inputs)
    if value is None or isinstance(value, tuple | list) or jnp.shape(value) != ():
        given = "None" if value is None else f"shapes {_tree.shapes(value)}"
        fix = "Return one number, and write one dvax.Event for each"
        raise input_error(f"{_CALLER}(function)", given, "it must be one number", fix)
    reset = event.reset
    if reset is not None:
        after = _shapes("reset", reset, inputs)
        if not _tree.same_shape(after, x):
            given, rule = (
                f"shapes {_tree.shapes(after)}",
                f"it must be those of x, {_tree.shapes(x)}",
            )
            fix = "Return the whole state behind the event"
            raise input_error(f"{_CALLER}(reset)", given, rule, fix)
        reset = convert(reset, *inputs.values())
    function = convert(event.function, *inputs.values())
    parts = lambda e: (e.function, e.reset)  # noqa: E731
    return eqx.tree_at(parts, event, (function, reset), is_leaf=lambda leaf: leaf is None)


def _shapes(name: str, fn: Any, inputs: dict[str, Any]) -> Any:
    """Return the shapes of fn(t, x, u, args), with errors that name the user's code."""
    arrays, static = eqx.partition(inputs, eqx.is_array)

    def traced(arrays: Any) -> Any:
        values = eqx.combine(arrays, static)
        named = {key: values[key] for key in inputs}  # JAX sorts the keys
        out = _user_code.call(name, fn, named, caller=_CALLER)
        _user_code.check_values(name, fn, out, named["x"], caller=_CALLER)
        return out

    return jax.eval_shape(traced, arrays)
