"""The tools and hand-written programs that a user would use instead of dvax."""
