"""A solve as a compiled program in a file, which runs without the code of the problem.

The file is a zip archive: `header.json` with the names, shapes and types of the inputs, the versions
and the platforms; `program`, serialised by `jax.export`; `example.npz`, the inputs of the example.
Nothing in it is unpickled.
"""

import io
import json
import os
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import _tree
from .._dataset import Names
from .._tree import Tree
from ..errors import InputError, SolveError, input_error
from .dataset import solution_dataset
from .event import Events
from .results import RESULTS, is_success

FORMAT = 1
"""Version of the file format. Older versions stay readable."""

_PLACE = "dvax.load_exported"


class Input(NamedTuple):
    """An array that the program takes: its name in messages, shape and type."""

    name: str
    shape: tuple[int, ...]
    dtype: str

    @classmethod
    def of(cls, name: str, leaf: Any) -> "Input":
        return cls(name, tuple(jnp.shape(leaf)), jnp.result_type(leaf).name)

    def convert(self, given: Any) -> Any:
        """Return `given` as this input. Python numbers take its type; arrays must have it.

        **Raises:** `dvax.InputError`.
        """
        if not isinstance(given, jax.Array | np.ndarray | np.generic):
            given = _of_numbers(given, self.dtype)
        shape, dtype = getattr(given, "shape", None), getattr(given, "dtype", None)
        if shape != self.shape or dtype != self.dtype:
            what = type(given).__name__ if dtype is None else f"{dtype} of shape {shape}"
            raise input_error(
                f"the exported program ({self.name})", what,
                f"the program was compiled for {self.dtype} of shape {self.shape}",
                "Convert it, or export the problem again with such an example",
            )  # fmt: skip
        return given


class Header(NamedTuple):
    """The description of an exported program.

    - `state`, `control`: the structures of x and u, None for an array and a list for a tuple;
      `inputs`: all inputs, in the order of `Exported.__call__`; `static`: names and texts of the leaves
      of args that are no arrays, which are compiled in; `saves`: `ts` is an input;
    - `results`: the names of the results by their code; `event_names`: of the events, or None.
    """

    format: int
    dvax: str
    jax: str
    calling_convention: int
    platforms: Sequence[str]
    method: str
    derivatives: int
    state: Any
    control: Any
    inputs: list[Input]
    static: list[tuple[str, str]]
    saves: bool
    results: list[str]
    event_names: list[str | None] | None


class ExportedSolution(NamedTuple):
    """The result of an exported program: the fields of `dvax.Solution` of the same names.

    Where a run fails, the times that it did not reach are ∞, their states NaN, and all derivatives
    NaN; `result` says why.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: args["load"] - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> sol = dvax.export(problem, -1.0, 0.0, 2.0, {"load": 3.0})()
    >>> isinstance(sol, dvax.evolution.ExportedSolution)
    True
    >>> print(f"{float(sol.xs[0]):.6f}", dvax.RESULTS[sol.result])
    1.836092 The end time was reached.

    ```
    """

    ts: jax.Array
    xs: Tree
    us: Tree
    ys: Tree
    law_residual: jax.Array
    law_step: jax.Array
    law_error: jax.Array | None
    defect: jax.Array | None
    stats: dict[str, Any]
    events: Events | None
    result: RESULTS

    def raise_if_failed(self) -> "ExportedSolution":
        """Return this solution if the run succeeded, else raise a `dvax.SolveError` with it."""
        if not is_success(self.result):
            raise SolveError(RESULTS[self.result], self, ())
        return self

    def to_xarray(
        self,
        states: Names = None,
        responses: Names = None,
        *,
        time_unit: str = "",
        bound: Any = None,
    ) -> Any:
        """Return the saved trajectory as an `xarray.Dataset`, as `Solution.to_xarray` does."""
        return solution_dataset(self, states, responses, time_unit, bound)


class Exported:
    """A compiled program that solves one problem, made by `dvax.export` or `dvax.load_exported`.

    It is called like the problem was solved: `exported(x0, t0, t1, args, ts)`. What is left out is that
    of the example. It may be called inside `jax.jit` and `jax.lax.map` (JAX has no `jax.vmap` of an
    exported program), and `jax.grad` differentiates it as many times as `derivatives=` said. `header`
    holds the inputs, versions and platforms.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: args["load"] - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> run = dvax.export(problem, -1.0, 0.0, 2.0, {"load": 3.0})
    >>> isinstance(run, dvax.evolution.Exported)
    True
    >>> print(f"{float(run(0.5, args={'load': 2.0}).xs[0]):.4f}")
    1.2918

    ```
    """

    def __init__(self, header: Header, program: bytes, example: list[np.ndarray]):
        self.header, self._program, self._example = header, program, example
        self._exported = _deserialise(header, program)
        self._run = jax.jit(self._solution)

    def __call__(
        self, x0: Tree = None, t0: Any = None, t1: Any = None, args: Any = None, ts: Any = None
    ) -> ExportedSolution:
        """Run the program.

        **Raises:** `dvax.InputError` if an input has another structure, shape or type than that of the
        example. A run that fails does not raise: see `ExportedSolution.result`.
        """
        platform = jax.export.default_export_platform()
        if platform not in self.header.platforms:
            raise input_error(
                "the exported program", f"the platform {platform}",
                f"it was compiled for {', '.join(self.header.platforms)}",
                f'Export it with platforms=["{platform}"]',
            )  # fmt: skip
        if not jax.config.read("jax_enable_x64") and self.header.inputs[0].dtype == "float64":
            raise input_error(
                "the exported program", "a process with 32-bit numbers",
                "it was compiled for float64",
                "Call jax.config.update('jax_enable_x64', True) first",
            )  # fmt: skip
        try:
            return self._run(self._inputs(x0, t0, t1, args, ts))
        except NotImplementedError as error:
            raise input_error(
                "the exported program", "a call inside jax.vmap or jax.jvp",
                f"JAX does not transform exported programs so: {_tree.line(error)}",
                "Use jax.lax.map for a batch, and jax.grad for derivatives",
            ) from error  # fmt: skip

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the program to a file, which is complete at every moment."""
        path = Path(path)
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            part.write_bytes(self.to_bytes())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)

    def to_bytes(self) -> bytes:
        """Return the contents of the file, for `dvax.load_exported`."""
        example, archive = io.BytesIO(), io.BytesIO()
        np.savez(example, *self._example)
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("header.json", json.dumps(self.header._asdict()))
            file.writestr("program", self._program)
            file.writestr("example.npz", example.getvalue())
        return archive.getvalue()

    def _inputs(self, x0: Tree, t0: Any, t1: Any, args: Any, ts: Any) -> list[Any]:
        header, count = self.header, len(_leaves(self.header.state))
        if x0 is not None and not _has_structure(x0, header.state):
            raise input_error(
                "the exported program (x0)", _tree.line(_tree.shapes(x0)),
                f"the state of the example is {_described(header.state)}",
                "Give that structure, or export the problem again",
            )  # fmt: skip
        if ts is not None and not header.saves:
            raise input_error(
                "the exported program (ts)", "saved times",
                "the program saves t1 alone, since the example had no ts=",
                "Export the problem with as many times as you want",
            )  # fmt: skip
        given = [None] * count if x0 is None else jtu.tree_leaves(x0)
        given += [t0, t1] + ([ts] if header.saves else [])
        names = [spec.name for spec in header.inputs[len(given) :]]
        given += [None] * len(names) if args is None else self._leaves_of_args(args, names)
        return [
            one if leaf is None else spec.convert(leaf)
            for spec, leaf, one in zip(header.inputs, given, self._example, strict=True)
        ]

    def _leaves_of_args(self, args: Any, names: list[str]) -> list[Any]:
        arrays, static = split_args(args)
        expected = names, [tuple(one) for one in self.header.static]
        if ([name for name, _ in arrays], static) != expected:
            raise input_error(
                "the exported program (args)",
                ", ".join([name for name, _ in arrays] + [" = ".join(one) for one in static]),
                "the example has " + ", ".join(names + [" = ".join(o) for o in expected[1]])
                + ", and what is no array is compiled in",
                "Give args of that structure, or export the problem again",
            )  # fmt: skip
        return [leaf for _, leaf in arrays]

    def _solution(self, inputs: list[Any]) -> ExportedSolution:
        returned: Any = self._exported.call(inputs)
        fields: dict[str, Any] = dict(returned)
        state, control = self.header.state, self.header.control
        for name, parts in (("xs", state), ("us", control), ("ys", control)):
            fields[name] = rebuild(parts, fields[name])
        code, result = fields.pop("code"), RESULTS.successful
        for k, name in enumerate(self.header.results):
            result = RESULTS.where(code == k, getattr(RESULTS, name), result)
        fields["stats"]["x"] = rebuild(state, fields["stats"]["x"])
        events = fields["events"]
        if events is not None:
            xs, after = (rebuild(state, events[name]) for name in ("xs", "xs_after"))
            names = tuple(self.header.event_names or ())
            fields["events"] = Events(events["ts"], events["index"], xs, after, names)
        return ExportedSolution(**fields, result=result)


def load_exported(source: str | os.PathLike[str] | bytes) -> Exported:
    """Return the program in a file that `Exported.save` wrote, or in its bytes.

    The functions of the problem are neither needed nor traced: the program is compiled for this machine
    at its first call. Programs are readable by JAX releases up to six months newer than the one that
    exported them (the guarantee of `jax.export`).

    **Raises:** `dvax.InputError` if the file is not readable or no such program, or if this version of
    dvax or JAX is too old or too new for it.

    ```python
    >>> import dvax
    >>> model = dvax.models.Contact(alpha=1.0, beta=1.0, b_x=2.0, b_u=1.0, d_x=0.5, d_u=1.0,
    ...                             kappa0=0.5, g=1.0, ell=3.0)
    >>> contents = dvax.export(model.problem, -1.0, 0.0, 2.0).to_bytes()
    >>> run = dvax.load_exported(contents)
    >>> print(f"{float(run(-1.0).xs[0]):.4f} {float(run(0.5).xs[0]):.4f}")
    1.8361 1.9253

    ```
    """
    place = f"{_PLACE}({'bytes' if isinstance(source, bytes) else str(source)!r})"
    rule, fix = "it must be a program that dvax.export wrote", "Export the problem again"
    try:
        data = source if isinstance(source, bytes) else Path(source).read_bytes()
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            header = json.loads(file.read("header.json"))
            _check_format(place, header)
            header["inputs"] = [Input(n, tuple(s), d) for n, s, d in header["inputs"]]
            program = file.read("program")
            with np.load(io.BytesIO(file.read("example.npz")), allow_pickle=False) as arrays:
                example = [arrays[name] for name in arrays.files]
        return Exported(Header(**header), program, example)
    except OSError as error:
        text = error.strerror or str(error)
        raise input_error(place, text, "the file must be readable", "Correct the path") from error
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError, EOFError) as error:
        if isinstance(error, InputError):
            raise
        raise input_error(place, "a file that is damaged, or none of dvax", rule, fix) from error


def _check_format(place: str, header: Any) -> None:
    if header["format"] > FORMAT:
        raise input_error(
            place, f"a file of dvax {header['dvax']}, in format {header['format']}",
            f"this version reads formats up to {FORMAT}",
            f"Install dvax {header['dvax']} or newer",
        )  # fmt: skip
    unknown = [name for name in header["results"] if not hasattr(RESULTS, name)]
    low = jax.export.minimum_supported_calling_convention_version
    high = jax.export.maximum_supported_calling_convention_version
    if unknown or not low <= header["calling_convention"] <= high:
        raise input_error(
            place, f"a program of dvax {header['dvax']} and JAX {header['jax']}",
            f"JAX {jax.__version__} and this version of dvax do not run it",
            "Install the versions that exported it, or export the problem again",
        )  # fmt: skip


def _deserialise(header: Header, program: bytes) -> jax.export.Exported:
    require_serialisation()
    try:
        return jax.export.deserialize(bytearray(program))
    except Exception as error:
        # JAX documents no exceptions of its parser.
        raise input_error(
            _PLACE, f"a program of JAX {header.jax}",
            f"JAX {jax.__version__} cannot read it: {_tree.line(error)}",
            "Install the version that exported it, or export the problem again",
        ) from error  # fmt: skip


def require_serialisation() -> None:
    """Raise a `dvax.InputError` if the package that `jax.export` needs for files is missing."""
    try:
        import flatbuffers  # noqa: F401
    except ImportError as error:
        raise input_error(
            "dvax.export", "no module 'flatbuffers'", "jax.export writes its programs with it",
            'pip install "dvax[export]"',
        ) from error  # fmt: skip


def split_args(args: Any) -> tuple[list[tuple[str, Any]], list[tuple[str, str]]]:
    """Return the leaves of args that are numbers, and the texts of the others, with their names."""
    arrays, static = [], []
    for path, leaf in jtu.tree_leaves_with_path(args):
        name = f"args{jtu.keystr(path)}"
        if isinstance(leaf, float | jax.Array | np.ndarray):
            arrays.append((name, leaf))
        else:
            static.append((name, repr(leaf)))
    return arrays, static


def structure(tree: Tree) -> Any:
    """Return the structure of a state or control: None for an array, a list for a tuple."""
    return [structure(part) for part in tree] if isinstance(tree, tuple) else None


def rebuild(structure: Any, leaves: list[Any]) -> Tree:
    """Return the tree of this structure with these leaves; named tuples become tuples."""
    rest = iter(leaves)

    def build(node: Any) -> Tree:
        return next(rest) if node is None else tuple(map(build, node))

    return build(structure)


def _leaves(structure: Any) -> list[Any]:
    return [None] if structure is None else [leaf for part in structure for leaf in _leaves(part)]


def _has_structure(given: Any, expected: Any) -> bool:
    return structure(given) == expected


def _described(structure: Any) -> str:
    if structure is None:
        return "an array"
    return f"a tuple of ({', '.join(map(_described, structure))})"


def _of_numbers(given: Any, dtype: str) -> Any:
    """Return numbers and lists of numbers as an array of this type, and anything else unchanged."""
    try:
        array = np.asarray(given)
    except (TypeError, ValueError):
        return given
    return array.astype(dtype) if array.dtype.kind in "fiu" and dtype.startswith("float") else given
