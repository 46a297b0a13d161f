"""Worlds of the physics engine MuJoCo as instances: joints and bodies are variables. Only here it is imported."""
