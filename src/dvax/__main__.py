"""The command line as `python -m dvax`."""

from .app.cli import main

if __name__ == "__main__":
    main()
