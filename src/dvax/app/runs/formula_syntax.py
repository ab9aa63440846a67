"""The limits of a formula's text, and its syntax tree.

The length is checked before the text is parsed, and the number and depth of nodes before anything
recurses over them.
"""

import ast
import re
import warnings

from dvax.errors import InputError, input_error

MAX_CHARACTERS = 4096
MAX_NODES = 512
MAX_DEPTH = 64


def parse_formula(text: str, names: tuple[str, ...], place: str) -> ast.expr:
    """The syntax tree of a text within the limits, its offsets counted from its first non-blank.

    Raises `InputError`, and nothing else, for every other text.
    """

    def refuse(column: int | None, given: str, rule: str, fix: str) -> InputError:
        where = place if column is None else f"{place}, column {column}"
        return input_error(where, given, rule, fix)

    if not isinstance(text, str):
        raise refuse(
            None, f"{text!r:.60}", "an expression is a text", 'Write it in quotes: "sin(t)".'
        )
    if len(text) > MAX_CHARACTERS:
        raise refuse(
            None,
            f"{len(text)} characters",
            f"an expression has at most {MAX_CHARACTERS} characters",
            "Put long data into a CSV or NPY file (series, profile).",
        )
    # One byte a character makes the parser's byte offsets columns, and no look-alike letter passes.
    odd = re.search(r"[^ -~\t\r\n]|#", text)
    if odd is not None:
        rule = "an expression is plain ASCII without comments"
        raise refuse(odd.start() + 1, repr(odd[0]), rule, "Remove this character.")
    flat = text.translate({9: " ", 10: " ", 13: " "})
    if not flat.strip():
        raise refuse(
            None, "an empty text", "an expression gives a number", f"Write {example_of(names)}."
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a doubtful literal such as `1if` becomes a SyntaxError
            tree = ast.parse(flat.strip(), mode="eval").body
    except (RecursionError, MemoryError):
        raise refuse(
            None, shown(flat), f"an expression nests at most {MAX_DEPTH} deep", "Write it flatter."
        ) from None
    except (SyntaxError, ValueError) as error:
        # The parser says 0 where it missed something after the last character.
        offset = getattr(error, "offset", None) or len(flat.strip()) + 1
        lead = len(flat) - len(flat.lstrip())
        reason = error.msg if isinstance(error, SyntaxError) and error.msg else str(error)
        raise refuse(
            offset + lead,
            shown(flat),
            f"it is not a formula: {reason.splitlines()[0]}",
            f"Write one formula such as {example_of(names)}.",
        ) from None
    nodes, depth = _size(tree)
    # Check the depth first: older parsers fail at it before the number of nodes is known.
    if depth > MAX_DEPTH:
        raise refuse(
            None,
            f"nesting {depth} deep",
            f"an expression nests at most {MAX_DEPTH} deep",
            "Write it flatter: group the terms of a long sum in parentheses.",
        )
    if nodes > MAX_NODES:
        raise refuse(
            None,
            f"{nodes} terms and operations",
            f"an expression has at most {MAX_NODES} nodes",
            "Put long data into a CSV or NPY file (series, profile).",
        )
    return tree


def example_of(names: tuple[str, ...]) -> str:
    """A formula in the given names, for error messages."""
    return f'"1 + 0.5*sin({names[0]})"' if names else '"2*pi"'


def _size(tree: ast.expr) -> tuple[int, int]:
    """Return (number of nodes, depth) without recursion, since the depth is not checked yet."""
    nodes, depth, level = 0, 0, [tree]
    while level:
        nodes, depth = nodes + len(level), depth + 1
        level = [
            child
            for node in level
            for child in ast.iter_child_nodes(node)
            if not isinstance(child, ast.operator | ast.unaryop | ast.cmpop | ast.expr_context)
        ]
    return nodes, depth


def shown(text: str) -> str:
    """A text in quotes, shortened for a message."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def kind_of(node: ast.AST) -> str:
    """Return the word for a node that is not part of the language."""
    words = {
        ast.Attribute: "an attribute (a dot)",
        ast.Subscript: "a subscript (brackets)",
        ast.Lambda: "a lambda",
        ast.IfExp: "an if",
        ast.BoolOp: "and/or",
        ast.JoinedStr: "a formatted text",
        ast.NamedExpr: "an assignment (:=)",
        ast.Starred: "a star",
        ast.BinOp: "this operator",
        ast.UnaryOp: "this operator",
        ast.Tuple: "a list of values",
        ast.List: "a list of values",
    }
    return words.get(type(node), f"a {type(node).__name__}")
