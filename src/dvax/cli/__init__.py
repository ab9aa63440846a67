"""The command line: `dvax run`, `check`, `report`, `demo`, `doctor`.

Thin: it reads what the user typed, calls the rooms below, and says what came of it. Nothing heavy
is imported before a command needs it, so that `dvax --help` answers at once.
"""

import sys


def main() -> None:
    """The entry point of the `dvax` program."""
    try:
        from dvax.cli.app import app
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.split(".")[0] == "dvax":
            raise
        sys.exit(
            f"The command line needs the package {missing.name}, which is not installed. "
            "Install dvax with its application: pip install 'dvax[app]'."
        )
    app()
