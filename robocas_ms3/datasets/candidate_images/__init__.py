"""Images of the decisions in ``candidates.h5``: render them, and read them.

`images_file` defines the file, `render` writes it from the states of the decisions.
"""
