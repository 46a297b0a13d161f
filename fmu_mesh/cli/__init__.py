"""The command line: arguments, progress, exit codes. The only package that prints."""
