"""What a `ros` section asks for, opened on the session towards ROS: its profiles, and the services of the node."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import zenoh

from ...config.mesh import RosConfig
from ...wire.keys import Keys
from ..messages.definitions import MessageTypes
from .parameters import ParameterServices
from .profile import Profile
from .rmw_zenoh import RmwZenoh
from .ros2dds import Ros2Dds
from .topics import RosPlan

__all__ = ["open_profiles", "parameter_services"]


@contextmanager
def open_profiles(
    section: RosConfig, session: zenoh.Session, types: MessageTypes, plan: RosPlan
) -> Iterator[dict[str, Profile]]:
    """The profiles that a plan needs, that of the section first."""
    names = dict.fromkeys((section.profile, *(topic.profile for topic in plan.topics)))
    profiles: dict[str, Profile] = {}
    try:
        for name in names:
            if name == "rmw_zenoh":
                profiles[name] = RmwZenoh(session, types, plan, section.domain)
            else:
                profiles[name] = Ros2Dds(session, types)
        yield profiles
    finally:
        for profile in profiles.values():
            profile.close()


def parameter_services(
    plan: RosPlan, types: MessageTypes, mesh: zenoh.Session, keys: Keys, profiles: dict[str, Profile]
) -> AbstractContextManager[None]:
    """The services for the parameters, where the mesh is a node of rmw_zenoh; nothing elsewhere."""
    node = profiles.get("rmw_zenoh")
    if not isinstance(node, RmwZenoh):
        return nullcontext()
    return ParameterServices(plan, types, mesh, keys).served_by(node)
