"""What goes over the network of ROS: topics, definitions, CDR, names, stamps, and how topics look on Zenoh.

The gateway, bags and kinds of instances use it, so it knows none of them.
"""
