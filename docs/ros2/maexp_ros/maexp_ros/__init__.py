"""A team of robots that explore, for ROS 2."""
