"""Nodes of ROS 2 of another maker at a router, beside ours: what is lost, and how late the rest comes."""
