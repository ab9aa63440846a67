"""Events of the user: a function whose zeros are located, and what happens there."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from .._repr import is_known, table, value_text
from .._tree import Tree
from ..errors import InputProblem, Problems, input_error
from .dataset import events_dataset

_MAX_SHOWN = 10


class Event(eqx.Module):
    """A time at which g(t, x(t), u(t)) reaches zero, for `dvax.solve(events=[…])`.

    - `function(t, x, u, args)` = g, one real number;
    - `direction`: 1 counts zeros that g reaches from below, −1 those from above, 0 both;
    - `terminal`: end the run at the first such time;
    - `reset(t, x, u, args)`: return the state with which the run continues (an impulse, a switch of a
      parameter that is a component of the state); None leaves it unchanged;
    - `name`: for `Events.of`.

    **Raises:** `dvax.InputError` for arguments of another kind.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> ball = dvax.Problem(
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0),
    ...     K=dvax.sets.Box(jnp.zeros(2), jnp.ones(2)),
    ...     f=lambda t, x, u, args: jnp.stack([x[1], -2.0 + 0.0 * u[0]]),
    ...     h=lambda t, x, u, args: -u,
    ... )
    >>> impact = dvax.Event(
    ...     lambda t, x, u, args: x[0], direction=-1,
    ...     reset=lambda t, x, u, args: jnp.stack([x[0], -0.5 * x[1]]),
    ... )
    >>> sol = dvax.solve(ball, jnp.array([1.0, 0.0]), 0.0, 2.2, events=[impact])
    >>> [f"{t:.6f}" for t in sol.events.ts]                # falls for 1, and flies for 1
    ['1.000000', '2.000000']

    ```
    """

    function: Callable[[Any, Tree, Tree, Any], Any]
    terminal: bool = eqx.field(static=True, default=False, kw_only=True)
    direction: int = eqx.field(static=True, default=0, kw_only=True)
    reset: Callable[[Any, Tree, Tree, Any], Tree] | None = eqx.field(default=None, kw_only=True)
    name: str | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self) -> None:
        wrong = Problems(
            InputProblem(f"dvax.Event({name})", repr(given)[:120], f"it must be {kind}", fix)
            for name, given, holds, kind, fix in (
                ("function", self.function, callable(self.function),
                 "callable as (t, x, u, args)", "Write lambda t, x, u, args: …"),
                ("terminal", self.terminal, isinstance(self.terminal, bool),
                 "True or False", "Omit it for False"),
                ("direction", self.direction,
                 not isinstance(self.direction, bool) and self.direction in (-1, 0, 1),
                 "1, −1 or 0", "Omit it for both directions"),
                ("reset", self.reset, self.reset is None or callable(self.reset),
                 "callable as (t, x, u, args)", "Omit it to leave the state unchanged"),
                ("name", self.name, isinstance(self.name, str | None), "text", "Omit it"),
            )
            if not holds
        )  # fmt: skip
        wrong.raise_any()

    @property
    def stops(self) -> bool:
        """Whether a step must end at the event."""
        return self.terminal or self.reset is not None


class Events(eqx.Module):
    """The events of a run, in the order in which they happened.

    - `ts`: their times; `index`: the positions of the events in `events=[…]`;
    - `xs`: the state in which each event happened: left of the time, but behind the resets of events
      that happened before it at the same time; `xs_after`: the state behind its reset;
    - `names`: the names of all events in `events=[…]`.

    Where the solve is traced (`jax.jit`), there are `max_events` rows, the last of which are empty:
    time ∞, index −1, states NaN.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
    ...     f=lambda t, x, u, args: 1.0 + 0.0 * x, h=lambda t, x, u, args: x,
    ... )
    >>> half = dvax.Event(lambda t, x, u, args: x - 0.5, name="half")
    >>> full = dvax.Event(lambda t, x, u, args: x - 1.0, name="full")
    >>> sol = dvax.solve(problem, 0.0, 0.0, 2.0, events=[full, half])
    >>> sol.events.index.tolist(), [f"{t:.6f}" for t in sol.events.of("half").ts]
    ([1, 0], ['0.500000'])

    ```
    """

    ts: jax.Array
    index: jax.Array
    xs: Tree
    xs_after: Tree
    names: tuple[str | None, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        if not is_known(self.index) or self.index.ndim != 1:
            rows = [("ts", value_text(self.ts)), ("index", value_text(self.index))]
            return table("Events: a trace or a batch", rows)
        happened = [(float(t), int(k)) for t, k in zip(self.ts, self.index, strict=True) if k >= 0]
        rows = [(f"t = {t:.10g}", self.names[k] or f"events[{k}]") for t, k in happened]
        more = (
            [(f"… {len(rows) - _MAX_SHOWN} more", "to_xarray()")] if len(rows) > _MAX_SHOWN else []
        )
        return table(f"Events: {len(rows)}", rows[:_MAX_SHOWN] + more)

    def of(self, name: str) -> "Events":
        """Return the events of this name, of a solve that is not traced.

        **Raises:** `dvax.InputError` if no event has this name.
        """
        if name not in self.names:
            rule = f"it must be one of {[n for n in self.names if n is not None]}"
            fix = "Give the event this name: dvax.Event(…, name=…)"
            raise input_error("Events.of", repr(name), rule, fix)
        wanted = [k for k, own in enumerate(self.names) if own == name]
        return self.rows(jax.numpy.isin(self.index, jax.numpy.asarray(wanted)))

    def to_xarray(self) -> Any:
        """Return the events as an `xarray.Dataset` with dimension `event`: time, index, name, states.

        **Raises:** `ModuleNotFoundError` if xarray (the extra `dvax[app]`) is not installed.
        """
        return events_dataset(self.ts, self.index, self.names, self.xs, self.xs_after)

    def rows(self, selection: Any) -> "Events":
        """Return some of the rows."""
        return jax.tree_util.tree_map(lambda leaf: leaf[selection], self)
