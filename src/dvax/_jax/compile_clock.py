"""The time that JAX spends on tracing, lowering and compilation, from its monitoring events."""

from collections.abc import Callable

import jax

_STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}

_listeners: list[Callable[[str, float], None]] = []


def listen(listener: Callable[[str, float], None]) -> None:
    """Register `listener(stage, seconds)`, to be called after every "trace", "lower" and "compile".

    If JAX does not report these events, it is never called, and compile times are reported as 0.
    """
    if not _listeners:
        _register()
    _listeners.append(listener)


def _register() -> None:
    try:
        register = jax.monitoring.register_event_duration_secs_listener
    except AttributeError:
        return
    register(_report)


def _report(event: str, duration_secs: float, **_: str | int) -> None:
    stage = _STAGES.get(event)
    if stage is not None:
        for listener in _listeners:
            listener(stage, duration_secs)
