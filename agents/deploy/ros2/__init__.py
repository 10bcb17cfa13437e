"""ROS 2 on the wire, without ROS: the arena served over DDS, and our policies driving a team that is out there."""
