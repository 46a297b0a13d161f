"""Who may do what with a mesh: certificates, roles, and what Zenoh is told of them."""
