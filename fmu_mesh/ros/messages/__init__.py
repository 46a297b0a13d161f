"""ROS messages: topics, definitions, CDR, names, stamps, and which variables fit into which fields."""
