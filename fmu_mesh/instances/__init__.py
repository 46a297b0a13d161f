"""The kinds of instances: one contract, one registry, and a folder for each kind."""
