"""The applications as runs: what `[model] name = "..."` of a configuration may be besides contact."""
