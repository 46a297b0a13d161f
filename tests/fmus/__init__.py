"""FMUs that only tests use, and what tests need to run any FMU directly."""
