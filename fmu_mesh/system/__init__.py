"""What a configuration means: names, graph, delays and plan, as pure values. No FMU, no Zenoh, no process."""
