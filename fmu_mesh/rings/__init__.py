"""How rows travel between instances: rings, and what moves rows from one ring to another."""
