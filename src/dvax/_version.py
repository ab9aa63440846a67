"""The version of the installed package, which its build reads from the newest tag."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("dvax")
except PackageNotFoundError:  # a source tree on the path that is not installed
    __version__ = "0+unknown"
