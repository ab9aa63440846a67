"""The result of `dvax.ensemble`."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._dataset import Names, Variable, dataset, described, over, required
from .._repr import table, value_text
from .._tree import Tree
from ..errors import input_error
from ..evolution import RESULTS, Solution
from ..evolution.dataset import leaves_of
from .alone import Alone
from .moments import Moments


class Fold(NamedTuple):
    """A reduction over the members that succeeded, in their order: carry = add(carry, value), from
    `start`; `value` is what a member's `observe=` returns. `add` is a JAX function.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, load: load - 0.5 * x - u,
    ...     h=lambda t, x, u, load: 1.0 - 2.0 * x - u,
    ... )
    >>> largest = dvax.Fold(-jnp.inf, lambda carry, x: jnp.maximum(carry, jnp.max(x)))
    >>> found = dvax.ensemble(
    ...     problem, -1.0, 0.0, 2.0, jnp.linspace(2.0, 4.0, 11), folds={"largest": largest}
    ... )
    >>> bool(found.folded["largest"] == jnp.max(found.values))
    True

    ```
    """

    start: Tree
    add: Callable[[Tree, Tree], Tree]


@dataclasses.dataclass(frozen=True)
class Ensemble:
    """The members of `dvax.ensemble`, of which some may have failed.

    - `values`: what `observe=` returned, a leading axis counting the members; NaN where a member failed
      before it was reached, None with `keep=False`;
    - `failed`: for each member, whether it failed; `results`: its `dvax.RESULTS`, with a leading axis;
      `ts`: the time that it reached;
    - `steps`, `rejected`: its numbers of accepted and rejected steps; `switched`: whether another
      method went on where stability or rounding limited the steps of the first; `method`: their names,
      with the reason where dvax chose;
    - `moments`: count, mean and squares of the members that succeeded (`dvax.ensembles.Moments`);
    - `folded`: the results of `folds=`, by name.

    ```python
    >>> import dvax, jax.numpy as jnp
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, load: load - 0.5 * x - u,
    ...     h=lambda t, x, u, load: 1.0 - 2.0 * x - u,
    ... )
    >>> found = dvax.ensemble(problem, -1.0, 0.0, 2.0, jnp.linspace(2.0, 4.0, 11))
    >>> found.values.shape, bool(found.failed.any())
    ((11,), False)
    >>> print(f"{float(found.mean):.3f} ± {float(found.std):.3f}, median {found.quantile(0.5):.3f}")
    1.835 ± 0.426, median 1.836

    ```
    """

    values: Tree | None
    failed: Any
    results: Any
    ts: Any
    steps: Any
    rejected: Any
    switched: Any
    method: str
    moments: Moments
    folded: Mapping[str, Tree]
    alone: Alone | None = dataclasses.field(repr=False, default=None)

    def __repr__(self) -> str:
        failed = int(self.failed.sum()) if _tree.is_concrete(self.failed) else "?"
        shown = ("values", "mean", "std", "steps", "rejected")
        return table(
            f"Ensemble: {len(self)} members, {failed} failed",
            [("method", self.method), *((name, value_text(getattr(self, name))) for name in shown)],
        )

    def __len__(self) -> int:
        return len(self.failed)

    @property
    def mean(self) -> Tree:
        """The mean of the members that succeeded."""
        return self.moments.mean

    @property
    def std(self) -> Tree:
        """Their standard deviation, with count − 1 in the denominator."""
        return self.moments.standard_deviation()

    def quantile(self, q: Any) -> Tree:
        """Return the quantiles q in [0, 1] of the members that succeeded; for a list of them, with a
        leading axis.

        **Raises:** `dvax.InputError` if the values were not kept, or q is not in [0, 1].
        """
        if _tree.is_concrete(q) and not np.all((np.asarray(q) >= 0) & (np.asarray(q) <= 1)):
            raise input_error(
                "Ensemble.quantile(q)", _tree.line(q), "quantiles are from 0 to 1",
                "Write 0.95 for 95 %",
            )  # fmt: skip
        if self.values is None:
            raise input_error(
                "Ensemble.quantile", "an ensemble with keep=False",
                "quantiles are computed from the values of all members",
                "Observe little, such as observe=lambda sol: sol.xs[-1], and keep it",
            )  # fmt: skip
        xp = _tree.array_module(self.values, self.failed)
        if xp is np:
            valid = ~self.failed
            if not valid.any():
                return jtu.tree_map(
                    lambda leaf: np.full(np.shape(q) + leaf.shape[1:], np.nan), self.values
                )
            rows = lambda leaf: leaf[valid].astype(float) if leaf.dtype == bool else leaf[valid]  # noqa: E731
            return jtu.tree_map(lambda leaf: np.quantile(rows(leaf), q, axis=0), self.values)

        def quantile(leaf: Any) -> Any:
            away = self.failed.reshape(-1, *(1,) * (leaf.ndim - 1))
            return xp.nanquantile(xp.where(away, xp.nan, leaf), xp.asarray(q), axis=0)

        return jtu.tree_map(quantile, self.values)

    def to_xarray(
        self,
        ts: Any = None,
        *,
        name: str = "value",
        time_unit: str = "",
        parameters: Mapping[str, Any] | None = None,
    ) -> Any:
        """Return the ensemble as an `xarray.Dataset` with dimension `member`.

        Its variables are the values (`name`, or the keys of a dictionary), `failed`, `reached_time`,
        `steps`, `rejected` and `switched`. With `keep=False` they are `name_mean` and `name_std`.

        **Arguments:** `ts`: the saved times, which become the coordinate of the axis that follows the
        members, where it has their number; `parameters`: names and values that differ between the
        members, one row each, which become coordinates.

        **Raises:** `dvax.InputError` if a parameter has another number of rows; `ModuleNotFoundError`
        if xarray (the extra `dvax[app]`) is not installed.

        ```python
        >>> import dvax, numpy as np
        >>> problem = dvax.Problem(
        ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0),
        ...     K=dvax.sets.Box(0.0, 0.5), f=lambda t, x, u, load: load - x - u,
        ...     h=lambda t, x, u, load: 1.0 - x,
        ... )
        >>> ts, loads = [0.0, 1.0, 2.0], np.linspace(1.0, 2.5, 4)
        >>> found = dvax.ensemble(problem, 0.0, 0.0, 2.0, loads, ts)
        >>> data = found.to_xarray(ts, parameters={"load": loads})
        >>> data["value"].dims, data["load"].values.tolist()
        (('member', 'time'), [1.0, 1.5, 2.0, 2.5])

        ```
        """
        count = None if ts is None else np.size(ts)
        kept = (("", self.values),) if self.values is not None else ()
        reduced = (("_mean", self.mean), ("_std", self.std)) if self.values is None else ()
        variables: dict[str, Variable] = {}
        for suffix, tree in (*kept, *reduced):
            lead = () if suffix else ("member",)
            for label, leaf in leaves_of(tree, name).items():
                axes = np.shape(leaf)[len(lead) :]
                dims = (*lead, "time") if axes and axes[0] == count else lead
                words = f"observed {label}" + suffix.replace("_", ", ")
                variables[label + suffix] = over(dims, label, leaf, described(words))
        for label, values, words in (
            ("failed", self.failed, "whether the member failed"),
            ("reached_time", self.ts, "time that the member reached"),
            ("steps", self.steps, "accepted steps"),
            ("rejected", self.rejected, "rejected steps"),
            ("switched", self.switched, "whether another method went on"),
        ):
            variables[label] = ("member",), values, described(words)
        has_time = any("time" in dims for dims, _, _ in variables.values())
        time = (("time",), ts, described("time", time_unit or None))
        coords: dict[str, Variable] = {"time": time} if has_time else {}
        for label, rows in (parameters or {}).items():
            if np.shape(rows)[:1] != (len(self),) or label in {"time", *variables}:
                raise input_error(
                    "Ensemble.to_xarray(parameters)", f"{label} of shape {np.shape(rows)}",
                    f"a parameter has a row for each of the {len(self)} members, and a name of its own",
                    "Give the values that the members were solved with",
                )  # fmt: skip
            coords[label] = over(("member",), label, rows, described(f"parameter {label}"))
        return dataset("Ensemble.to_xarray", variables, coords, {"method": self.method})

    def plot(
        self,
        ts: Any,
        quantiles: tuple[float, float] = (0.05, 0.95),
        *,
        names: Names = None,
        name: str = "value",
        unit: str = "",
        time_unit: str = "",
        title: str | None = None,
        backend: str = "matplotlib",
        axes: Any = None,
    ) -> Any:
        """Return a figure of the kept values over time: their mean, and the area between two quantiles
        of the members that succeeded.

        **Arguments:** `ts`: the saved times, one for each row of the values; `names`: of the entries of
        the values, a dictionary of names and units or a list, or else `name`, `unit`: of the values as
        a whole; `title`, `backend`, `axes`: as in `dvax.Solution.plot`.

        **Raises:** `ModuleNotFoundError` if Matplotlib or Plotly (the extra `dvax[app]`) is missing;
        `dvax.InputError` if values were not kept, or are not over these times.
        """
        for module in ("matplotlib", "plotly"):
            required(module, "Ensemble.plot")
        # Upward, since pictures belong to the application.
        from ..app.plots.ensemble import plot_ensemble

        return plot_ensemble(
            self, ts, quantiles, names=names, name=name, unit=unit, time_unit=time_unit, title=title,
            backend=backend, axes=axes,
        )  # fmt: skip

    def failures(self) -> dict[int, str]:
        """Return the result of each failed member, with the time that it reached and what is wrong with
        its data, in sentences, by its number."""
        # Messages are looked up by arrays of JAX.
        each = lambda k: jtu.tree_map(lambda leaf: jnp.asarray(leaf[k]), self.results)  # noqa: E731
        failed = np.flatnonzero(np.asarray(self.failed)).tolist()
        nonfinite = np.asarray(self.results == RESULTS.nonfinite)
        wrong: dict[int, str] = {}
        if self.alone is not None:
            wrong = self.alone.invalid_data({k: float(self.ts[k]) for k in failed if nonfinite[k]})
        return {
            k: f"{RESULTS[each(k)]} Stopped at t = {float(self.ts[k]):.10g} after "
            f"{int(self.steps[k])} steps." + (f" {wrong[k]}" if k in wrong else "")
            for k in failed
        }

    def member(self, k: int) -> Solution:
        """Solve member k alone.

        **Raises:** `dvax.SolveError` with the cause, if it fails; `dvax.InputError` if the ensemble is
        part of a compiled program.
        """
        if self.alone is None:
            raise input_error(
                "Ensemble.member", "an ensemble inside a compiled program",
                "its inputs have no values", "Call it outside of jax.jit and jax.grad",
            )  # fmt: skip
        if not -len(self) <= k < len(self):
            raise input_error(
                "Ensemble.member(k)", str(k), f"members are numbered from 0 to {len(self) - 1}",
                "Give such a number",
            )  # fmt: skip
        return self.alone.solve(k)


jtu.register_dataclass(
    Ensemble,
    [f.name for f in dataclasses.fields(Ensemble) if f.name not in ("method", "alone")],
    ["method", "alone"],
)
