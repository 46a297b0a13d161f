"""A node: one process that steps its instances as soon as their inputs are there and the grant allows."""
