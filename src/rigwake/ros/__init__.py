"""A ROS node on board. Needs no workspace and no cv_bridge: messages are read by rigwake's own readers."""
