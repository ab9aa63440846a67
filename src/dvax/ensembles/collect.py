"""The rows of an ensemble, solved piece by piece and collected."""

import sys
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax

from .. import _tree
from .._tree import Tree
from ..errors import input_error
from ..evolution.arguments import machine_memory
from .inputs import Inputs
from .members import Program, Row
from .moments import Moments
from .result import Fold
from .workers import in_order

_PIECES, _LONGEST_PIECE = 64, 4096
"""Number of pieces that an ensemble is cut into, so that threads end at about the same time, and the
most members of a piece."""

_PIECE_BYTES = 2**26
"""Bytes of the saved states of a piece."""


class Collected:
    """What is kept of the members: tables with a row for each, moments, and folds."""

    def __init__(self, count: int, keep: bool, folds: Mapping[str, Fold], progress: bool):
        self.count, self.keep, self.folds, self.progress = count, keep, folds, progress
        self.rows: Row | None = None
        self.moments: Moments | None = None
        self.folded: dict[str, Tree] = {name: fold.start for name, fold in folds.items()}
        self.started, self.done = time.monotonic(), 0

    def add(self, members: np.ndarray, found: Row) -> None:
        """Add the rows of these members."""
        if self.rows is None:
            self.rows = self._tables(found)
        observed = found.observed
        if not self.keep:
            found = found._replace(observed=None)
        self.put(members, found)
        valid = ~found.failed
        moments = Moments.of(observed, valid)
        self.moments = moments if self.moments is None else self.moments.merge(moments)
        for name, fold in self.folds.items():
            self.folded[name] = _compiled_fold(fold.add, self.folded[name], observed, valid)
        self.done += len(members)
        if self.progress:
            self._show()

    def take(self, members: np.ndarray) -> Row:
        """Return the rows of these members."""
        return jtu.tree_map(lambda table: table[members], self.rows)

    def put(self, members: np.ndarray, rows: Row) -> None:
        """Replace the rows of these members."""
        jtu.tree_map(lambda table, row: table.__setitem__(members, row), self.rows, rows)

    def _tables(self, found: Row) -> Row:
        """Return tables for all members, from the rows of some."""
        if not self.keep:
            found = found._replace(observed=None)
        leaves = jtu.tree_leaves(found)
        needed = sum(leaf.nbytes // len(leaf) for leaf in leaves) * self.count
        available = machine_memory()
        if needed > available:
            raise input_error(
                "dvax.ensemble(keep)", "True",
                f"the observed values of {self.count} members need {needed / 2**30:.3g} GiB, and "
                f"the machine has {available / 2**30:.3g} GiB",
                "Observe less of each member, or pass keep=False and folds=",
            )  # fmt: skip
        table = lambda leaf: np.empty((self.count, *leaf.shape[1:]), leaf.dtype)  # noqa: E731
        return jtu.tree_map(table, found)

    def _show(self) -> None:
        assert self.rows is not None
        done = min(self.done, self.count)
        spent = time.monotonic() - self.started
        left = spent * (self.count - done) / max(done, 1)
        end = "\n" if done == self.count else ""
        line = f"\rdvax.ensemble: {done} of {self.count} members, {left:.0f} s left "
        sys.stderr.write(line + end)
        sys.stderr.flush()


def collect(
    into: Collected, program: Program, inputs: Inputs, members: np.ndarray, devices: list[Any]
) -> bool:
    """Solve these members and add their rows; return False, with nothing added, where values that the
    code closes over are traced."""
    lanes = program.signature.options.lanes
    size = _piece(inputs, len(members), lanes)
    pieces = [members[k : k + size] for k in range(0, len(members), size)]
    on_device: dict[Any, Program] = {}

    def run(piece: np.ndarray, device: Any) -> Row:
        if device not in on_device:
            on_device[device] = program.on(device)
        # One length for all pieces, and one program: the last one repeats a member.
        padded = np.concatenate([piece, np.repeat(piece[-1:], size - len(piece))])
        found = on_device[device].run(jax.device_put(inputs.rows(padded), device))
        if not _tree.is_concrete(found):
            return found
        return jtu.tree_map(lambda leaf: np.asarray(leaf)[: len(piece)], found)

    for piece, found in zip(pieces, in_order(pieces, run, devices), strict=True):
        if not _tree.is_concrete(found):
            return False
        into.add(piece, found)
    return True


def _piece(inputs: Inputs, count: int, lanes: int) -> int:
    """Return the number of members of a piece."""
    x0, _, _, _, ts = inputs.member(0)
    saved = 1 if ts is None else len(ts)
    state = sum(np.asarray(leaf).nbytes for leaf in jtu.tree_leaves(x0))
    most = max(1, min(_LONGEST_PIECE, _PIECE_BYTES // max(1, saved * state)))
    wanted = -(-count // _PIECES)
    if lanes == 1:
        # A power of two: ensembles of about as many members run the same program.
        return 2 ** min((wanted - 1).bit_length(), most.bit_length() - 1)
    pieces = -(-count // min(most, count, max(lanes, wanted)))
    return -(-count // pieces)


def fold_rows(add: Any, start: Tree, rows: Tree, valid: Any) -> Tree:
    """Return the fold of the rows that are valid."""

    def step(carry: Tree, row: tuple[Tree, Any]) -> tuple[Tree, None]:
        return _tree.where(row[1], add(carry, row[0]), carry), None

    start = jtu.tree_map(jnp.asarray, start)
    return lax.scan(step, start, (rows, valid))[0]


_compiled_fold = partial(jax.jit, static_argnums=0)(fold_rows)
