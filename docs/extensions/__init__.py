"""Extensions of Sphinx for the site of dvax."""
