"""Instances whose steps come from programs that we did not start."""
