"""FMUs that are compiled from their sources for WebAssembly, and run in a sandbox of wasmtime (ADR 101)."""
