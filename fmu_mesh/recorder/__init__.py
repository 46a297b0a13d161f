"""Recording: writes the rows of all instances, combined by point, into the result file."""
