"""A running mesh in Foxglove: live values, parameters, log messages and states, over a WebSocket."""
