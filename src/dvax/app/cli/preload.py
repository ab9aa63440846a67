"""What the report needs, loaded while the compiler works.

Plotly and Matplotlib take a second or two to import. Compiling the time loop takes longer and is
no Python, so that both go on side by side.
"""

from contextlib import suppress
from importlib import import_module
from threading import Thread

from dvax.app.cli.progress import Event, Listener


def loaded_ahead(module: str, listener: Listener) -> Listener:
    """A listener in the place of `listener` that imports `module` once the run compiles.

    What goes wrong there goes wrong again, and is said, where the module is used.
    """

    def listen(event: Event) -> None:
        if event["event"] == "compiling":
            # Nobody waits for it: who needs the module imports it, and waits for this import then.
            Thread(target=_load, args=(module,), name="dvax load", daemon=True).start()
        listener(event)

    return listen


def _load(module: str) -> None:
    with suppress(Exception):
        import_module(module)
