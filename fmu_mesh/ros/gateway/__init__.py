"""The gateway to ROS: carries samples between variables and topics, over a Zenoh bridge or rmw_zenoh."""
