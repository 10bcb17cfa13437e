"""Our teams in a simulator that is not ours: ir-sim, with a lidar, a map made from its ranges, and the runtime's goals.

Nothing here reads the floor but `floor`, which builds the world, and `coverage`, which judges: the robots know what
their lidars and odometry tell them.
"""
