"""Components in Python as a kind of instances: what a user derives from, and how it is found, described and stepped."""
