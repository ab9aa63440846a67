"""Matrices in CSV files: a row a line, numbers alone."""

from pathlib import Path

import numpy as np

from .table import NUMBER, FileProblems, csv_rows


def read_matrix(path: Path) -> np.ndarray:
    """Return the matrix of a CSV file of numbers without a header.

    **Raises:** `dvax.InputError` with every cell that is no number, and every row of another length.
    """
    problems = FileProblems(path)
    rows = csv_rows(path, problems)
    if not rows:
        problems(None, "no rows", "a matrix has rows of numbers", "Write a row a line: 0, 1")
    width = len(rows[0][1]) if rows else 0
    for line, cells in rows:
        if len(cells) != width:
            rule = f"every row has as many numbers as the first one, {width}"
            problems(line, f"{len(cells)} numbers", rule, "Add or remove numbers")
        for number, cell in enumerate(cells, start=1):
            if not NUMBER.fullmatch(cell.strip()):
                rule = "every entry of a matrix is a number, and the file has no header"
                problems(line, repr(cell[:60]), rule, "Write a number such as 0.5", number)
    problems.check()
    return np.array([[float(cell) for cell in cells] for _, cells in rows])
