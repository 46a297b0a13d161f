"""Recording: rows of all instances, put together by point, into the result file."""
