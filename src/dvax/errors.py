"""The exceptions of dvax. Every message states what is wrong, the rule, and the fix."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


class DvaxError(Exception):
    """The base class of all exceptions of dvax.

    ```python
    >>> import dvax
    >>> try:
    ...     dvax.sets.Box(1.0, 0.0)
    ... except dvax.DvaxError as error:
    ...     print(type(error).__name__)
    InputError

    ```
    """


@dataclass(frozen=True)
class InputProblem:
    """A problem with the input of the user.

    `place` is its location (a file with line and column, a dotted key, an argument's name), `given` the
    value, `rule` the requirement with its reason, and `fix` the remedy.
    """

    place: str
    given: str
    rule: str
    fix: str

    def __str__(self) -> str:
        return f"{self.place}: got {self.given}; {self.rule}. {self.fix}"


class InputError(DvaxError, ValueError):
    """The input of the user violates a rule. The error lists all problems, not only the first.

    ```python
    >>> import dvax
    >>> try:
    ...     dvax.sets.Box(1.0, 0.0)
    ... except dvax.InputError as error:
    ...     print(error.problems[0].given)
    ...     print(error.problems[0].fix)
    lower = 1, upper = 0
    Swap the bounds, or widen the interval

    ```
    """

    problems: tuple[InputProblem, ...]

    def __init__(self, *problems: InputProblem):
        # What several keys have in common, such as a file, is a problem once.
        self.problems = problems = tuple(dict.fromkeys(problems))
        super().__init__("\n".join(map(str, problems)))


def input_error(place: str, given: str, rule: str, fix: str) -> InputError:
    """Return an `InputError` with one problem; the arguments are those of `InputProblem`."""
    return InputError(InputProblem(place, given, rule, fix))


class Problems(list[InputProblem]):
    """A list of problems that are raised together.

    `cause` is the first error that was collected: its traceback leads to the place in the user's code.
    """

    cause: InputError | None = None

    def add(self, place: str, given: str, rule: str, fix: str) -> None:
        """Append a problem; the arguments are those of `InputProblem`."""
        self.append(InputProblem(place, given, rule, fix))

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Append the problems of an `InputError` that the block raises, and continue after it."""
        try:
            yield
        except InputError as error:
            self += error.problems
            self.cause = self.cause or error

    def raise_any(self) -> None:
        """Raise an `InputError` if there are problems."""
        cause = self.cause
        if cause is not None and cause.problems == tuple(self):
            # One traceback, without the notes that JAX adds to an error.
            raise InputError(*self).with_traceback(cause.__traceback__) from cause.__cause__
        if self:
            raise InputError(*self) from cause


@dataclass(frozen=True)
class Fix:
    """A remedy for a `SolveError`: an option, a value for it, and the reason `why`.

    If `option` is empty, `why` is a complete sentence.
    """

    option: str
    value: str
    why: str

    def in_python(self) -> str:
        """Return the remedy as an argument of `dvax.solve`."""
        if not self.option:
            return self.why
        value = f"dvax.{self.value}()" if self.option == "method" else self.value
        value = f"dvax.vi.{self.value}()" if self.option == "vi_solver" else value
        return f"Pass {self.option}={value}, {self.why}"


class SolveError(DvaxError, RuntimeError):
    """A solve failed before its end; `solution` is the partial result, if there is one.

    `cause` describes the failure and its evidence. `fixes` names options that may help, so that a
    caller with other names for them (the keys of a configuration file) can phrase them differently.

    ```python
    >>> import dvax
    >>> problem = dvax.Problem(                    # x' = 1 + x² is infinite at t = π/2
    ...     A=dvax.generators.Zero(), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 1.0),
    ...     f=lambda t, x, u, args: 1.0 + x**2, h=lambda t, x, u, args: 0.5 - u,
    ... )
    >>> try:
    ...     dvax.solve(problem, 0.0, 0.0, 3.0, method=dvax.DormandPrince())
    ... except dvax.SolveError as error:
    ...     print(error.fixes[0].option, f"{float(error.solution.stats['t']):.3f}")
    t1 1.571

    ```
    """

    def __init__(self, cause: str, solution: object = None, fixes: tuple[Fix, ...] = ()):
        self.cause, self.solution, self.fixes = cause, solution, fixes
        super().__init__(self.message(Fix.in_python))

    def message(self, phrase: Callable[[Fix], str | None]) -> str:
        """Return the message, with `phrase(fix)` for each fix; None omits it."""
        texts = [text for fix in self.fixes if (text := phrase(fix))]
        return " ".join([self.cause, *(f"{text}." for text in texts)])


class DifferentiationError(DvaxError, TypeError):
    """The chosen adjoint does not support the requested differentiation mode.

    ```python
    >>> import dvax, jax
    >>> problem = dvax.Problem(
    ...     A=dvax.generators.Scalar(-1.0), P=dvax.operators.Scaling(1.0), K=dvax.sets.Box(0.0, 0.5),
    ...     f=lambda t, x, u, args: 3.0 - 0.5 * x - u,
    ...     h=lambda t, x, u, args: 1.0 - 2.0 * x - u,
    ... )
    >>> try:
    ...     jax.jvp(lambda x: dvax.solve(problem, x, 0.0, 2.0).xs[0], (-1.0,), (1.0,))
    ... except dvax.DifferentiationError as error:
    ...     print("forward" in str(error))
    True

    ```
    """
