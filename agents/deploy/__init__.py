"""Policies on robots: the torch-free planner, ROS 2, and trials in ir-sim."""
