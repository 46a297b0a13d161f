"""The master: grants points to the nodes, watches them, and ends the run."""
