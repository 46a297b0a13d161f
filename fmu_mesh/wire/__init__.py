"""How this project uses Zenoh: keys, messages, sessions, the inbox.

Only this package opens sessions. `node`, `master`, `recorder` and `ros` also import zenoh, and use a session that they
are given.
"""
