"""A running mesh from outside: finding it, asking it, following it, waiting for it."""
