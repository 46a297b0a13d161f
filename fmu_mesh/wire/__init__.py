"""Everything that touches Zenoh: keys, messages, sessions, the inbox. The only package that imports zenoh."""
