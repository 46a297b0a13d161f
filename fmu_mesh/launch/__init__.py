"""Launching: from a configuration to running processes, and their supervision."""
