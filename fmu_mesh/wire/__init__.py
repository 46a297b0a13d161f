"""Zenoh as this project uses it: keys, messages, sessions, the inbox.

Sessions are opened here only. `node`, `master`, `record` and `ros` import zenoh, too, and declare on a session that
they are given.
"""
