"""The one family of exceptions. Every message says what is wrong, the mend, and the reason."""

from dataclasses import dataclass


class DvaxError(Exception):
    """Base of every error that dvax raises on purpose."""


@dataclass(frozen=True)
class InputProblem:
    """One thing wrong with what the user gave.

    `place` says where (a file with line and column, a dotted key, an argument's name), `given` what
    was found there, `rule` what is required and why, `mend` what to do about it.
    """

    place: str
    given: str
    rule: str
    mend: str

    def __str__(self) -> str:
        return f"{self.place}: got {self.given}; {self.rule}. {self.mend}"


class InputError(DvaxError, ValueError):
    """What the user gave breaks a rule. All problems found are listed, not only the first."""

    problems: tuple[InputProblem, ...]

    def __init__(self, *problems: InputProblem):
        self.problems = problems
        super().__init__("\n".join(map(str, problems)))


class SolveError(DvaxError, RuntimeError):
    """A solve stopped before its end; the partial result is in `solution` where there is one."""

    def __init__(self, message: str, solution: object = None):
        self.solution = solution
        super().__init__(message)


class DifferentiationError(DvaxError, TypeError):
    """A derivative was asked for in a mode that the chosen adjoint cannot serve."""
