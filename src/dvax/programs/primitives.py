"""Classes of JAX primitives, by name, that several domains treat alike."""

REARRANGING = frozenset({
    "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "slice", "copy",
    "copy_p", "stop_gradient", "tile",
})  # fmt: skip
"""Each entry of the result is an entry of the argument, at a position independent of values."""

JOINING = frozenset({"concatenate", "stack", "split", "unstack"})
"""The same for several arguments or results."""

SUMMING = frozenset({"reduce_sum", "cumsum"})

ORDERING = frozenset({"lt", "le", "gt", "ge", "lt_to", "le_to"})

COMPARING = ORDERING | {"eq", "ne", "eq_to"}

LOGICAL = frozenset({"and", "or", "xor", "not"})

STEPWISE = frozenset({"sign", "floor", "ceil", "round"})
"""Increasing, piecewise constant functions."""

TABLES = frozenset({"dvax_constant_table", "dvax_linear_table", "dvax_cubic_table"})
"""Names of the functions that evaluate a `dvax.signals.Table`."""
