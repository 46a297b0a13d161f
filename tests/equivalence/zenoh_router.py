"""A Zenoh router on a free loopback port, standing in for the router's image.

Prints its endpoint once it listens, and ends when its standard input does.
"""

import json
import sys

import zenoh


def main() -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("adminspace/enabled", "true")  # knows the port that the system chose
    with zenoh.open(config) as session:
        reply = next(iter(session.get(f"@/{session.info.zid()}/router")))
        if reply.ok is None:
            raise SystemExit("the router does not describe itself")
        print(json.loads(reply.ok.payload.to_string())["locators"][0], flush=True)  # noqa: T201 (it is the answer)
        sys.stdin.read()


if __name__ == "__main__":
    main()
