"""The master: it lets the nodes step, watches them, and ends the run."""
