"""Recognition of errors of JAX and Equinox by their text.

If a release changes the text, users see the original error instead of an explanation.
"""


def is_reverse_only(error: Exception) -> bool:
    """Return whether the error is forward differentiation of a function with a reverse rule only."""
    text = str(error)
    return "forward-mode autodiff" in text or "custom_vjp" in text


def is_equinox_check(error: Exception) -> bool:
    """Return whether the error is a failed check of Equinox (`eqx.error_if`) inside f or h."""
    return "_EquinoxRuntimeError" in str(error)
