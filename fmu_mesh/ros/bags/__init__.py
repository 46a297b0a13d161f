"""Bags (MCAP): recording into them, reading them, and playing them into a mesh."""
