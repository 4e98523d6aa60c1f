"""The builtin pack: everyday objects and furniture made of formulas, so that the package needs no downloads."""
