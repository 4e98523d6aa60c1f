"""Episodes of a protocol for a process of another environment of Python, which acts in them."""
