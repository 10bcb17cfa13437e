"""Starts the team's node; `ros2 launch maexp_ros team.launch.py params:=my_team.yaml`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    default = str(Path(get_package_share_directory("maexp_ros")) / "config" / "team.yaml")
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=default, description="parameters of the node"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="the clock of a simulator"),
            Node(
                package="maexp_ros",
                executable="team",
                name="team",
                output="screen",
                parameters=[LaunchConfiguration("params"), {"use_sim_time": LaunchConfiguration("use_sim_time")}],
            ),
        ]
    )
