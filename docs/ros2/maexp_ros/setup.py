"""For colcon: an ament_python package."""

from setuptools import setup

name = "maexp_ros"
setup(
    name=name,
    version="0.1.0",
    packages=[name],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
        (f"share/{name}/launch", ["launch/team.launch.py"]),
        (f"share/{name}/config", ["config/team.yaml"]),
        (f"share/{name}/rviz", ["rviz/team.rviz"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    license="MIT",
    description="One node that sends a team of robots exploring",
    entry_points={"console_scripts": ["team = maexp_ros.team_node:main"]},
)
