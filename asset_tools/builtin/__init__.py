"""Generate the builtin pack: everyday objects and furniture from Python code, so that no download is needed."""
