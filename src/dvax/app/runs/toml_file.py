"""A TOML file as a table, within limits that keep reading it cheap."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dvax.app.runs.schema_errors import shown
from dvax.errors import InputError, input_error

MAX_BYTES = 2**20
MAX_PARTS = 32
"""The most parts of a dotted key: the parser takes a time that is quadratic in their number."""
MAX_DEPTH = 32
"""The most levels of tables and lists within each other."""
MAX_TEXT = 10_000
"""The most characters of a key or of a text."""
MAX_KEYS = 2000
"""The most keys of a file: each unknown one is compared with those that are known."""

# Possessive and anchored at the start of a part, so that the search takes linear time.
_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:{_PART}\.[ \t]*+){{{MAX_PARTS}}}")


def read_toml(source: Path) -> dict[str, Any]:
    """Return a TOML file as a table. **Raises:** `InputError` with line and column, or the key."""

    name = source.name
    try:
        if not source.is_file():
            given = "a folder" if source.is_dir() else "no such file"
            raise input_error(
                str(source), given, "a configuration is a TOML file", "Check its name."
            )
        size = source.stat().st_size
        if size > MAX_BYTES:
            raise input_error(
                name,
                f"{size} bytes",
                f"a configuration has at most {MAX_BYTES} bytes",
                "Put data into CSV or NPY files.",
            )
        text = source.read_bytes().decode(
            "utf-8-sig"
        )  # Notepad begins a file with a byte-order mark
        _check_keys(text, name)
        content = tomllib.loads(text)
    except InputError:
        raise  # it is a ValueError too
    except OSError as error:
        raise input_error(
            str(source), error.strerror or str(error), "it must be readable", "Check it."
        ) from None
    except UnicodeDecodeError as error:
        raise input_error(
            f"{name}, byte {error.start + 1}",
            "bytes that are not UTF-8",
            "TOML is UTF-8",
            "Save it so.",
        ) from None
    except tomllib.TOMLDecodeError as error:
        message = str(error)
        found = re.search(r"\(at line (\d+), column (\d+)\)", message)
        place = f"{name}, line {found[1]}, column {found[2]}" if found else f"{name}, at its end"
        lines = text.splitlines() or [""]
        line = lines[min(int(found[1]), len(lines)) - 1] if found else lines[-1]
        raise input_error(place, repr(line.strip()[:120]), *_broken_toml(message, line)) from None
    except (RecursionError, ValueError) as error:
        # tomllib lets the errors of int() and of deep nesting through.
        raise input_error(
            name, shown(str(error)), "the file is not readable as TOML", "Write it simpler."
        ) from None
    _check_size(content, name)
    return content


_TOML = (
    ("Invalid value", "what stands after = is no value of TOML",
     'Write a number with a point (0.5), true or false, a text in "quotes", or a list [1, 2].'),
    ("Expected '=' after a key", "a line is key = value, or a heading [table]",
     "Write = between the key and its value, and put keys with blanks in quotes."),
    ("Invalid statement", "a line is key = value, or a heading [table]",
     "Start comments with #, and keys with a letter."),
    ("Cannot overwrite a value", "every key occurs once in its table",
     "Remove one of the two lines with this key."),
    ("Cannot declare", "every heading [table] occurs once, and [[table]] makes entries of a list",
     "Join the two tables, or write [[table]] for each entry."),
    ("Expected newline or end of document", "a value ends with its line",
     'Write one key = value a line, numbers as 0.5 or 1e-3, and quantities in quotes: "5 ms".'),
    ("Unterminated string", "a text ends with the quote it began with", "Close the quotes."),
    ("Illegal character", "a text in quotes stands on one line", "Close the quotes on this line."),
    ("Expected ']' at the end of a table", "a heading ends with ]", "Close the bracket."),
    ('Expected "\'"', "a text ends with the quote it began with", "Close the quotes."),
    ("Unclosed array", "a list ends with ]", "Close the bracket."),
    ("Unescaped", "a backslash in a text in quotes begins an escape",
     "Write paths with / or in 'single quotes'."),
)  # fmt: skip


def _broken_toml(message: str, line: str) -> tuple[str, str]:
    """The rule that a line breaks, and the fix, from what the parser says."""
    for start, rule, fix in _TOML:
        if message.startswith(start):
            return f"the file is not TOML: {rule}", fix
    reason = re.sub(r"\s*\(at .*\)$", "", message)
    return f"the file is not TOML ({reason})", 'Write key = value; texts in "quotes".'


def _check_keys(text: str, name: str) -> None:
    """Raise an `InputError` for a dotted key with more than `MAX_PARTS` parts, before it is parsed."""
    found = _LONG_KEY.search(text)
    if found is not None:
        line = text.count("\n", 0, found.start()) + 1
        raise input_error(
            f"{name}, line {line}",
            shown(found[0]),
            f"a key has at most {MAX_PARTS} parts with dots between",
            "Remove the line; no key of a model is that long.",
        )


def _check_size(content: Mapping[str, Any], name: str) -> None:
    """Raise an `InputError` for integers beyond 64 bits, deep nesting, and too many keys."""
    keys = 0
    level: list[tuple[str, Any]] = [("", content)]
    for _ in range(MAX_DEPTH + 1):
        below: list[tuple[str, Any]] = []
        for place, value in level:
            if isinstance(value, Mapping):
                keys += len(value)
                if keys > MAX_KEYS:
                    rule = f"a configuration has at most {MAX_KEYS} keys"
                    raise input_error(name, "more keys", rule, "Put data into CSV or NPY files.")
                below += [(_joined(place, key), v) for key, v in value.items()]
                texts = [*value, *(v for v in value.values() if isinstance(v, str))]
                _check_lengths(texts, f"{name}: {place}" if place else name)
            elif isinstance(value, list):
                below += [(place, v) for v in value]
                _check_lengths([v for v in value if isinstance(v, str)], f"{name}: {place}")
            elif isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise input_error(
                    f"{name}: {place}",
                    f"a whole number of {value.bit_length()} bits",
                    "whole numbers of TOML have at most 64 bits",
                    "Write a smaller number, or one with an exponent: 1e30.",
                )
        level = below
        if not level:
            return
    raise input_error(
        f"{name}: {level[0][0]}",
        "tables or lists within each other",
        f"they nest at most {MAX_DEPTH} deep",
        "Write it flatter.",
    )


def _check_lengths(texts: list[str], place: str) -> None:
    """Raise an `InputError` for a key or a text that is very long, and fills the messages about it."""
    long = next((text for text in texts if len(text) > MAX_TEXT), None)
    if long is not None:
        raise input_error(
            place,
            shown(long),
            f"a key or a text has at most {MAX_TEXT} characters",
            "Put data into CSV or NPY files.",
        )


def _joined(place: str, key: str) -> str:
    """Return a dotted key, cut off where it is long: each of many keys below a long one has it."""
    return (f"{place}.{key}" if place else key)[:100]
