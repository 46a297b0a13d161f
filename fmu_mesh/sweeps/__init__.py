"""Many runs of one mesh: variants, the processes that run them, one table."""
