"""The one family of exceptions. Every message says what is wrong, the fix, and the reason."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


class DvaxError(Exception):
    """Base of every error that dvax raises on purpose."""


@dataclass(frozen=True)
class InputProblem:
    """One thing wrong with what the user gave.

    `place` says where (a file with line and column, a dotted key, an argument's name), `given` what
    was found there, `rule` what is required and why, `fix` what to do about it.
    """

    place: str
    given: str
    rule: str
    fix: str

    def __str__(self) -> str:
        return f"{self.place}: got {self.given}; {self.rule}. {self.fix}"


class InputError(DvaxError, ValueError):
    """What the user gave breaks a rule. All problems found are listed, not only the first."""

    problems: tuple[InputProblem, ...]

    def __init__(self, *problems: InputProblem):
        self.problems = problems
        super().__init__("\n".join(map(str, problems)))


def input_error(place: str, given: str, rule: str, fix: str) -> InputError:
    """Return an `InputError` with one problem; the arguments are those of `InputProblem`."""
    return InputError(InputProblem(place, given, rule, fix))


class Problems(list[InputProblem]):
    """Problems found so far, which are raised together."""

    def add(self, place: str, given: str, rule: str, fix: str) -> None:
        """Append a problem; the arguments are those of `InputProblem`."""
        self.append(InputProblem(place, given, rule, fix))

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Append the problems of an `InputError` that the block raises, and go on after it."""
        try:
            yield
        except InputError as error:
            self += error.problems

    def raise_any(self) -> None:
        """Raise an `InputError` where there are problems."""
        if self:
            raise InputError(*self)


@dataclass(frozen=True)
class Fix:
    """An option that a caller may change after a `SolveError`: its name, a value for it, and why.

    Without an option, `why` is a sentence of its own.
    """

    option: str
    value: str
    why: str

    def in_python(self) -> str:
        """As an argument of `dvax.solve`."""
        if not self.option:
            return self.why
        value = f"dvax.{self.value}()" if self.option == "method" else self.value
        value = f"dvax.vi.{self.value}()" if self.option == "vi_solver" else value
        return f"Pass {self.option}={value}, {self.why}"


class SolveError(DvaxError, RuntimeError):
    """A solve stopped before its end; the partial result is in `solution` where there is one.

    `cause` says what happened and what the evidence is, `fixes` which options help, by name, so that a
    caller with other names for them (the keys of a file) can say it in its own words.
    """

    def __init__(self, cause: str, solution: object = None, fixes: tuple[Fix, ...] = ()):
        self.cause, self.solution, self.fixes = cause, solution, fixes
        super().__init__(self.told(Fix.in_python))

    def told(self, phrase: Callable[[Fix], str | None]) -> str:
        """The message, with each fix in the words of the caller; None drops one."""
        said = [text for fix in self.fixes if (text := phrase(fix))]
        return " ".join([self.cause, *(f"{text}." for text in said)])


class DifferentiationError(DvaxError, TypeError):
    """A derivative was asked for in a mode that the chosen adjoint cannot serve."""
