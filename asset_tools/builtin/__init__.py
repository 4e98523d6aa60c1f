"""Generate the builtin pack, everyday objects and furniture, from Python code without downloads."""
