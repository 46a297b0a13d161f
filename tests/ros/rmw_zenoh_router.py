"""A router as rmw_zenohd is by its configuration: it introduces peers to each other, and forwards nothing between them.

Arguments: its endpoint. It prints a line when it listens, and ends with its standard input.
"""

import json
import sys

import zenoh

SETTINGS = {
    "mode": "router",
    "listen/endpoints": sys.argv[1:],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "routing/router/peers_failover_brokering": False,
}

config = zenoh.Config()
for key, value in SETTINGS.items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("listening", flush=True)  # noqa: T201 (it is the answer)
    sys.stdin.read()
