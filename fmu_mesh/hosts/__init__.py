"""Where the processes of a run are, other than on this host: one file for each way to start them there."""
