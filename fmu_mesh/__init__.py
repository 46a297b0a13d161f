"""fmu_mesh: a service mesh for co-simulation on Eclipse Zenoh."""

__version__ = "0.1.0"
