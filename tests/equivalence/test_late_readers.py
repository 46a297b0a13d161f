"""Who waits for a key gets each value of it from the first one on, even if one is published in that moment."""

from __future__ import annotations

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from fmu_mesh.node.key_ends import FromTheFirst
from fmu_mesh.wire.session import matches
from tests.helpers import Place, wait_until
from tests.key_meshes import client, stepped_router

KEY = "late/values"


def test_a_late_reader_gets_all_values_in_their_order(place: Place) -> None:
    with stepped_router(place) as (_, endpoint), client(endpoint) as session:
        publisher = zenoh.ext.declare_advanced_publisher(
            session,
            KEY,
            cache=zenoh.ext.CacheConfig(512),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.2),
            publisher_detection=True,
        )
        told = session.declare_publisher(KEY)
        put = [str(number).encode() for number in range(60)]
        for value in put:
            publisher.put(value)

        def publish_for(status: zenoh.MatchingStatus) -> None:
            if status.matching:
                put.append(str(len(put)).encode())
                publisher.put(put[-1])

        listener = told.declare_matching_listener(Callback(publish_for, indirect=False))
        for count in range(61, 91):
            assert read_all(endpoint, count) == put[:count]
            wait_until(lambda: not matches(told), "the end of the reader")
        listener.undeclare()


def read_all(endpoint: str, count: int) -> list[bytes]:
    """What a new reader gets, up to ``count`` values."""
    found: list[bytes] = []
    with client(endpoint) as session:
        reader = FromTheFirst(session, lambda sample: found.append(sample.payload.to_bytes()))
        subscriber = zenoh.ext.declare_advanced_subscriber(
            session,
            KEY,
            Callback(reader, indirect=False),
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        wait_until(lambda: len(found) >= count, f"{count} values, and not {len(found)}")
        subscriber.undeclare()
    return found
