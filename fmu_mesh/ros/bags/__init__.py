"""Bags (MCAP): recording one, reading one, and playing one into a mesh."""
