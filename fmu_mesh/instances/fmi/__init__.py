"""FMUs: reading, extracting, loading and calling them. The only package that imports fmpy."""
