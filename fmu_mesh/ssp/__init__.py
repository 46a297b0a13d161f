"""System Structure and Parameterization (SSP 1.0 and 2.0): a package becomes a configuration, and a mesh a package."""
