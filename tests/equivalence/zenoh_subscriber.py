"""A plain Zenoh subscriber in a process of its own, which a test can stop.

Arguments: an endpoint and a key expression. Prints a line when the first sample has come, and ends when its standard
input does.
"""

from __future__ import annotations

import json
import sys
import threading

import zenoh


def main() -> None:
    endpoint, key = sys.argv[1:]
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    first = threading.Event()
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber(key, lambda _sample: first.set())
        if first.wait(30.0):
            print("receiving", flush=True)  # noqa: T201 (it is the answer)
        sys.stdin.read()
        subscriber.undeclare()


if __name__ == "__main__":
    main()
