"""Names and phrases that plain technical terms have replaced do not return.

`python -m tests.test_words` prints every occurrence, including those that are still allowed by
`PENDING_NAMES` and `PENDING_PHRASES`.
"""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
CODE = ("src", "tests", "benchmarks", "examples")
PROSE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs", "benchmarks", "examples")

# Old name -> what replaced it. These names are not used anywhere.
REPLACED = {
    "Ahead": "CriticalCone",
    "Aim": "EventBracket",
    "Blur": "RoundoffGuard",
    "Chord": "LinearEnclosure",
    "Expanded": "SpectralState",
    "Factors": "Propagators",
    "Heard": "a noun, with the attribute unresolved",
    "Memory": "SolverState",
    "Nothing": "NoJacobian",
    "Verdict": "StepDecision",
    "Visit": "Evaluation",
    "_CALM": "GROWTH_STEPS",
    "_DOUBT": "SAFETY",
    "_FEW": "a name of the quantity",
    "_MOST": "a name of the quantity",
    "_OTHER": "TRUST_RATIO or a name of the quantity",
    "_SMALL": "a name of the quantity",
    "_TRUST": "GROWTH_RATE",
    "_WILD": "DIVERGENCE_RATIO",
    "_one_function": "outlined",
    "any_of_batch": "any_lane",
    "arrivals": "left_derivative",
    "arriving": "left_derivative",
    "begun": "a noun",
    "bend": "curvature_bound",
    "calm": "accepted_in_a_row",
    "careful": "check_finite",
    "carries": "forward_mode",
    "chords": "enclosure",
    "complain": "print_error",
    "guarded": "check_finite",
    "hidden": "masked_error",
    "if_moving": "select_if_differentiated",
    "impulse": "integrated_defect",
    "is_moving": "is_differentiated",
    "joins": "explicit_in_A",
    "judge": "decide",
    "land": "clip_to_stop",
    "linearises": "is_rosenbrock",
    "medians": "small_box",
    "mend": "fix",
    "nothing_ahead": "no_event",
    "of_waves": "irfft",
    "own_turn": "is_active",
    "ranged": "track_bounds",
    "settled": "completed_defect",
    "slope_entrywise": "rules_elementwise",
    "slope_moves": "rules_structural",
    "spare": "error_budget",
    "talk": "console",
    "visits": "evaluations",
}


class Term(NamedTuple):
    """An old name that is also a legitimate term: it is replaced in some folders only."""

    new: str
    folders: tuple[str, ...]
    elsewhere: str  # the meanings for which the word remains


EVOLUTION = ("src/dvax/evolution",)
CONTROL = ("src/dvax/evolution/control",)
STEPPER = ("src/dvax/evolution/loop.py", "src/dvax/evolution/stepper.py")
THEORY = ("src/dvax/theory",)
PLOTS = ("src/dvax/app/plots",)

TERMS = {
    "Plan": Term(
        "Stages",
        tuple(f"src/dvax/evolution/{name}.py" for name in ("method", "runge_kutta", "evaluations")),
        "evolution/plan.py: how a run solves its law; app/runs: the plan of a run",
    ),
    "ahead": Term("preload", ("src/dvax/app/cli",), "later in time, or in a sequence"),
    "boundary": Term("step_start", CONTROL, "the boundary of a set, a domain or a mesh"),
    "elsewhere": Term("unresolved", ("src/dvax/signals",), "another place"),
    "extent": Term("bounds", (*EVOLUTION, *THEORY), "the extent of an image in Matplotlib"),
    "faces": Term("small_box", (), "the faces of a box; the old module is gone"),
    "filled": Term("instantiate_zeros", EVOLUTION, "filled contours, filled missing values"),
    "first_change": Term(
        "locate_event", ("src/dvax/evolution/locate_event.py", *CONTROL), "the first correction"
    ),
    "fits": Term("match", EVOLUTION, "whether shapes or sizes agree"),
    "fitted": Term("reuse_or_build", EVOLUTION, "fitted parameters"),
    "halves": Term("has_half_stage", EVOLUTION, "the two halves of an interval"),
    "inside": Term("interpolate", STEPPER, "membership in a set or an interval"),
    "kinks": Term("events", CONTROL, "kinks of a trajectory, as in dvax.sensitivity.kinks"),
    "known": Term("modulus_status", ("src/dvax/theory/known.py",), "what is given in advance"),
    "level": Term("noise_floor", CONTROL, "the level of a signal, of a tree, of a set"),
    "longest": Term(
        "reference_size", ("src/dvax/evolution/control/roundoff_guard.py",), "the largest step"
    ),
    "look": Term("estimate_defect, or theme", (*EVOLUTION, *PLOTS), "none; avoid it"),
    "motion": Term("set_motion", ("src/dvax/theory/motion.py",), "the motion of a set"),
    "moved": Term("transport", STEPPER, "a translated set or array"),
    "moving": Term("time_derivatives", EVOLUTION, "a set that depends on time"),
    "opened": Term("closure_convert", EVOLUTION, "an open file"),
    "passed": Term("discard_passed", EVOLUTION, "arguments, or tests that passed"),
    "record": Term("run_reader", PLOTS, "a ground-motion record; the saved rows of a loop"),
    "rest": Term(
        "nonlinear_part",
        ("src/dvax/evolution/method.py", "src/dvax/evolution/linearised.py"),
        "the remaining items; a body at rest",
    ),
    "rows": Term("assumptions", ("src/dvax/theory/rows.py",), "the rows of a matrix or a table"),
    "scan": Term("downsample", PLOTS, "jax.lax.scan"),
    "search": Term(
        "counterexample_search", ("src/dvax/theory/search.py",), "a search on a line, in a graph, …"
    ),
    "shift": Term("zero_with_tangent", (), "a translation, also in time"),
    "still": Term("jax.lax.stop_gradient", EVOLUTION, "a still picture in app/plots"),
    "turns": Term("bounded_while", ("src/dvax/generators",), "points of return; revolutions"),
    "until": Term("limit_to_event", CONTROL, "a final time"),
    "waves": Term("rfft", ("src/dvax/generators",), "sinusoidal waves"),
    "within": Term("one_sided_time", STEPPER, "inside an interval or a tolerance"),
    "written": Term("small_box", EVOLUTION, "files that were written"),
}

# Phrases of old prose, as regular expressions, with what to write instead.
PHRASES = {
    r"anew": "again",
    r"mend(s|ed|ing)?": "fix",
    r"(no|some|every)body('s)?": "a technical agent, or the passive voice",
    r"of one's own": "your own",
    r"which moves as t does": "Return zero with the tangent of t.",
    r"say nothing more": "After k accepted steps the growth factor is limited to 1 + 0.12 k², k ≤ 9.",
    r"defect that is rounding": "A defect dominated by roundoff does not decrease with h.",
    r"a shorter step would not (fix|mend)": "Every non-finite value can be cured by a smaller step.",
    r"that a loop begins with is a constant to XLA": "XLA allocates a buffer per literal value.",
    r"outputs that nobody looks at": "dead-code elimination rule",
    r"turns out to be of no use": "XLA aborts on unused arguments of an outlined call.",
    r"What XLA joins them by": "Reduce over all entries, unrolled for up to four.",
    r"Generators that are only applied": "Matrix-free generators",
    r"which nothing changes; making them": "Module-level defaults: constructing them is slow.",
    r"What a step leaves to the next": "the state that a step passes to the next",
}

# Phrases that remain: (file, phrase) -> why.
EXCEPTIONS = {("CHANGELOG.md", "mend"): "the old name of an attribute"}

# Not yet renamed: folder (or file) -> names. Delete an entry when its folder is clean.
PENDING_NAMES: dict[str, set[str]] = {
    "src/dvax/evolution": {"_SMALL", "bend", "guarded", "look", "moving"},
    "src/dvax/formats": {"begun"},
    "src/dvax/programs": {"_MOST", "_OTHER", "bend", "carries", "settled"},
}  # fmt: skip

# Not yet rewritten: folders (or files) of prose. Delete an entry when its folder is clean.
PENDING_PHRASES: tuple[str, ...] = (
    "src/dvax/app",
    "src/dvax/evolution/defect.py",
    "src/dvax/formats",
    "src/dvax/models",
    "src/dvax/theory",
)


class Use(NamedTuple):
    path: str
    line: int
    word: str
    new: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.word!r} -> {self.new}"


def lies_in(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder + "/")


@cache
def python_files() -> list[Path]:
    found = [file for folder in CODE for file in sorted((ROOT / folder).rglob("*.py"))]
    return [file for file in found if file != Path(__file__)]


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def identifiers(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Every identifier in the code with its line, definitions and uses alike."""
    for node in ast.walk(tree):
        match node:
            case ast.Name():
                yield node.id, node.lineno
            case ast.arg() | ast.keyword() if node.arg:
                yield node.arg, node.lineno
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name, node.lineno
            case ast.Attribute():
                yield node.attr, node.lineno
            case ast.alias():
                for part in re.split(r"\W+", f"{node.name} {node.asname or ''}"):
                    yield part, node.lineno
            case ast.ImportFrom() if node.module:
                for part in node.module.split("."):
                    yield part, node.lineno


def old_names(path: str, words: Iterator[tuple[str, int]]) -> Iterator[Use]:
    for word, line in words:
        if word in REPLACED:
            yield Use(path, line, word, REPLACED[word])
        elif word in TERMS and any(lies_in(path, folder) for folder in TERMS[word].folders):
            yield Use(path, line, word, TERMS[word].new)


def names_in_use() -> Iterator[Use]:
    for file in python_files():
        path = file.relative_to(ROOT).as_posix()
        parts = ((part, 0) for part in Path(path).with_suffix("").parts)
        yield from old_names(path, parts)
        yield from old_names(path, identifiers(parsed(file)))


def texts(file: Path) -> Iterator[tuple[str, int]]:
    """The prose of a file with the line where it begins: its strings and its blocks of comments."""
    source = file.read_text(encoding="utf-8")
    if file.suffix != ".py":
        yield source, 1
        return
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value, node.lineno
    block: list[str] = []
    first = last = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT:
            continue
        if block and token.start[0] != last + 1:
            yield "\n".join(block), first
            block = []
        if not block:
            first = token.start[0]
        block.append(token.string.lstrip("#"))
        last = token.start[0]
    if block:
        yield "\n".join(block), first


def old_phrases(path: str, text: str, first: int) -> Iterator[Use]:
    for phrase, new in PHRASES.items():
        for match in re.finditer(rf"\b{phrase}\b".replace(" ", r"\s+"), text, re.IGNORECASE):
            yield Use(path, first + text.count("\n", 0, match.start()), match.group(), new)


def prose_files() -> Iterator[Path]:
    for place in PROSE:
        yield from (
            sorted((ROOT / place).rglob("*.md")) if (ROOT / place).is_dir() else [ROOT / place]
        )


def phrases_in_use() -> Iterator[Use]:
    for file in [*python_files(), *prose_files()]:
        path = file.relative_to(ROOT).as_posix()
        for text, first in texts(file):
            for use in old_phrases(path, text, first):
                if (path, use.word) not in EXCEPTIONS:
                    yield use


def is_pending_name(use: Use) -> bool:
    return any(
        lies_in(use.path, place) and use.word in PENDING_NAMES[place] for place in PENDING_NAMES
    )


def is_pending_phrase(use: Use) -> bool:
    return any(lies_in(use.path, place) for place in PENDING_PHRASES)


def test_old_names_are_not_identifiers():
    """No identifier, module or folder has a name that was replaced."""
    uses = [use for use in names_in_use() if not is_pending_name(use)]
    assert not uses, "\n" + "\n".join(map(str, uses))


def test_old_phrases_are_not_in_the_prose():
    """No docstring, comment, message or page contains a phrase that was replaced."""
    uses = [use for use in phrases_in_use() if not is_pending_phrase(use)]
    assert not uses, "\n" + "\n".join(map(str, uses))


def test_replaced_names_and_terms_are_disjoint():
    """A name is either replaced everywhere, or a term with exceptions."""
    assert not set(REPLACED) & set(TERMS)


@pytest.mark.parametrize(
    ("path", "code", "expected"),
    [
        ("src/dvax/a.py", "def judge(x): return x", ["judge"]),
        ("src/dvax/a.py", "import a.spare as b", ["spare"]),
        ("src/dvax/a.py", "f(calm=1).bend", ["bend", "calm"]),
        ("src/dvax/evolution/control/a.py", "boundary = 3", ["boundary"]),
        ("src/dvax/sets/a.py", "boundary = 3", []),
        ("src/dvax/a.py", "text = 'judge'", []),
    ],
)
def test_old_name_is_found_in_code(path: str, code: str, expected: list[str]):
    """Definitions, uses, imports and keywords count; strings do not."""
    assert sorted(use.word for use in old_names(path, identifiers(ast.parse(code)))) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("It is made\nanew for every call.", ["anew"]),
        ("Mend the entries, or recommend others.", ["Mend"]),
        ("0, which moves\n    as t does", ["which moves\n    as t does"]),
        ("A new amendment.", []),
    ],
)
def test_old_phrase_is_found_in_text(text: str, expected: list[str]):
    """Phrases are found across line breaks and in any case, and not inside other words."""
    assert [use.word for use in old_phrases("a.md", text, 1)] == expected


if __name__ == "__main__":
    names, phrases = list(names_in_use()), list(phrases_in_use())
    for use in [*names, *phrases]:
        print(use)
    print(f"{len(names)} uses of old names, {len(phrases)} of old phrases")
    for place, words in PENDING_NAMES.items():
        unused = words - {use.word for use in names if lies_in(use.path, place)}
        if unused:
            print(f"no longer needed in PENDING_NAMES[{place!r}]: {sorted(unused)}")
    for place in PENDING_PHRASES:
        if not any(lies_in(use.path, place) for use in phrases):
            print(f"no longer needed in PENDING_PHRASES: {place!r}")
