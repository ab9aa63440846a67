"""What the report needs, loaded while the compiler works.

Plotly and Matplotlib take a second or two to import. Compiling the time loop takes longer and is
no Python, so that both go on side by side.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module

from dvax.cli.progress import Event, Listener


@contextmanager
def loaded_ahead(module: str, listener: Listener) -> Iterator[Listener]:
    """A listener in the place of `listener` that imports `module` once the run compiles.

    What goes wrong there goes wrong again, and is said, where the module is used.
    """
    with ThreadPoolExecutor(1) as pool:

        def listen(event: Event) -> None:
            if event["event"] == "compiling":
                pool.submit(import_module, module)
            listener(event)

        yield listen
