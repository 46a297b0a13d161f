"""From a configuration to a finished run: in one process, in many processes, and the roles of a process."""
