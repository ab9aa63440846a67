"""The limits of a formula's text, and its syntax tree.

Everything here happens before a single node is trusted: the length is checked before the parser
sees the text, the number and depth of nodes before anything recurses over them.
"""

import ast
import warnings

from dvax.errors import InputError, input_error

MAX_CHARACTERS = 4096
MAX_NODES = 512
MAX_DEPTH = 64


def parse_formula(text: str, names: tuple[str, ...], place: str) -> ast.expr:
    """The syntax tree of a text within the limits, its offsets counted from its first non-blank.

    Raises `InputError`, and nothing else, for every text that has none.
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
    for column, character in enumerate(text, start=1):
        # One byte a character makes the parser's byte offsets columns, and no look-alike letter
        # passes.
        if character == "#" or not _plain(character):
            raise refuse(
                column,
                repr(character),
                "an expression is plain ASCII without comments",
                "Remove this character.",
            )
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
    # The depth first, as parsers that give up at it say: Python 3.13 gives up much later.
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


def _plain(character: str) -> bool:
    return character.isascii() and (character.isprintable() or character in "\t\r\n")


def example_of(names: tuple[str, ...]) -> str:
    """A formula in the given names, for error messages."""
    return f'"1 + 0.5*sin({names[0]})"' if names else '"2*pi"'


def _size(tree: ast.expr) -> tuple[int, int]:
    """(number of nodes, depth), without recursion: the tree is still a stranger's."""
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
    """What a node outside the language is called by those who write formulas."""
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
