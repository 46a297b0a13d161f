"""Access to a running mesh from outside: find it, query it, follow it, wait for it."""
