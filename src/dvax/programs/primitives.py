"""Classes of JAX's primitives that several domains treat in one way, by name."""

REARRANGING = frozenset({
    "reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "slice", "copy",
    "copy_p", "stop_gradient",
})  # fmt: skip
"""Each entry of the result is an entry of the one argument, at a place that no value decides."""

JOINING = frozenset({"concatenate", "stack", "split"})
"""The same for several arguments or results."""

SUMMING = frozenset({"reduce_sum", "cumsum"})

ORDERING = frozenset({"lt", "le", "gt", "ge", "lt_to", "le_to"})

COMPARING = ORDERING | {"eq", "ne", "eq_to"}

LOGICAL = frozenset({"and", "or", "xor", "not"})

STEPWISE = frozenset({"sign", "floor", "ceil", "round"})
"""Increasing functions that are constant in pieces."""

TABLES = frozenset({"dvax_constant_table", "dvax_linear_table", "dvax_cubic_table"})
"""The values of a `dvax.signals.Table`: functions that dvax marks by their names."""
