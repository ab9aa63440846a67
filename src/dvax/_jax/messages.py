"""Errors of JAX and Equinox that are told apart by their text alone. Where a release words them
otherwise, the user sees the original error instead of an explanation."""


def is_reverse_only(error: Exception) -> bool:
    """Return whether a function with a reverse derivative alone was differentiated forward."""
    text = str(error)
    return "forward-mode autodiff" in text or "custom_vjp" in text


def is_equinox_check(error: Exception) -> bool:
    """Return whether a check of Equinox (`eqx.error_if`) inside f or h failed."""
    return "_EquinoxRuntimeError" in str(error)
