"""Double precision, asked for out loud: the library itself never changes a global setting."""


def enable_double() -> None:
    """Switch JAX of this process to 64-bit numbers. The manifest of a run records it."""
    import jax

    jax.config.update("jax_enable_x64", True)
