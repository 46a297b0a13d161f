"""What a configuration file may say: YAML to frozen Structs, and all findings with their places in the file."""
