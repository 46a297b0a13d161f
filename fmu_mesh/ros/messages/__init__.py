"""ROS messages: definitions, CDR, names, stamps, and how variables fit into them."""
