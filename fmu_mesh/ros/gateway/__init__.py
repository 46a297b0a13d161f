"""The gateway to ROS: topics from and to variables, over a Zenoh bridge or rmw_zenoh."""
