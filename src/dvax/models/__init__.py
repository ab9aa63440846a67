"""Ready models: a problem with its constants and what its figures mean."""

from .contact import Contact as Contact
