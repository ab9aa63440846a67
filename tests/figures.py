"""`python -m tests.figures`: the size of the code, and the lines on unstable interfaces of JAX."""

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

SOURCE = Path(__file__).parents[1] / "src" / "dvax"

UNSTABLE = re.compile(r"\bjax\.(interpreters|extend|_src)\b|\bjax\.experimental\b(?!\.sparse)")
"""Interfaces that JAX may change in any release. `jax.experimental.sparse` is a type of arguments that
users pass; `src` imports it nowhere."""

_LAYOUT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER, tokenize.ENCODING,
}  # fmt: skip


def main() -> None:
    counts: Counter[str] = Counter()
    for file in sorted(SOURCE.rglob("*.py")):
        counts[file.relative_to(SOURCE).parts[0].removesuffix(".py")] += code_lines(file)
    for room, count in sorted(counts.items(), key=lambda item: -item[1]):
        print(f"{count:7,} {room}")
    core = sum(counts[room] for room in ("evolution", "programs", "_jax"))
    print(f"{sum(counts.values()):7,} lines of code, without comments, docstrings and blank lines")
    print(f"{core:7,} of them in evolution, programs and _jax")
    print(
        f"{len(list(unstable_lines())):7,} lines outside _jax that use unstable interfaces of JAX"
    )


def code_lines(file: Path) -> int:
    """Return the number of lines that hold code."""
    source = file.read_text(encoding="utf-8")
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _LAYOUT:
            lines |= set(range(token.start[0], token.end[0] + 1))
    return len(lines - _docstring_lines(ast.parse(source)))


def _docstring_lines(tree: ast.Module) -> set[int]:
    """Return the lines of strings that stand as statements: docstrings of modules, classes, functions
    and constants."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            if isinstance(node.value.value, str):
                lines |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def unstable_lines() -> Iterator[str]:
    """Yield each line of code outside `_jax` that uses an unstable interface of JAX, with its place."""
    for file in sorted(SOURCE.rglob("*.py")):
        if file.parent.name == "_jax":
            continue
        source = file.read_text(encoding="utf-8")
        skipped = _docstring_lines(ast.parse(source))
        for number, line in enumerate(source.splitlines(), 1):
            code = re.sub(r"\"[^\"]*\"|#.*", "", line)
            if number not in skipped and UNSTABLE.search(code):
                yield f"{file.relative_to(SOURCE)}:{number}: {line.strip()}"


if __name__ == "__main__":
    main()
