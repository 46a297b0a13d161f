"""Where the processes of a mesh run besides this host: one file per engine."""
