"""Model-exchange FMUs: their calls, the solver, and the instance that steps them."""
