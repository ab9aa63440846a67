"""How long JAX spent tracing and compiling, so that it can be told apart from solving."""

import jax.monitoring

_EVENTS = "/jax/core/compile/"
_spent = 0.0
_listening = False


def compile_seconds() -> float:
    """Seconds spent on compilation since the first call of this function."""
    global _listening
    if not _listening:
        jax.monitoring.register_event_duration_secs_listener(_add)
        _listening = True
    return _spent


def _add(event: str, duration_secs: float, **_: str | int) -> None:
    global _spent
    if event.startswith(_EVENTS):
        _spent += duration_secs
