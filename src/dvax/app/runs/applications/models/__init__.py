"""The models of the command line: a module a model, with its `APPLICATION`."""
