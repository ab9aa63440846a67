"""Import what the report needs while the compiler works.

Plotly and Matplotlib take a second or two to import. Compiling the time loop takes longer and is
no Python, so that both run side by side.
"""

from contextlib import suppress
from importlib import import_module
from threading import Thread

from dvax.app.cli.progress import Event, Listener


def preload_when_compiling(module: str, listener: Listener) -> Listener:
    """A listener that passes events on to `listener`, and imports `module` once the run compiles.

    An import that fails fails again, and is reported, where the module is used.
    """

    def load() -> None:
        with suppress(Exception):
            import_module(module)

    def listen(event: Event) -> None:
        if event["event"] == "compiling":
            # No join: an import of the module waits for one that is under way.
            Thread(target=load, name="dvax preload", daemon=True).start()
        listener(event)

    return listen
