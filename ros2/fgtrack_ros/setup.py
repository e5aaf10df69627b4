"""Installs the node, its launch file, its parameters and the view of RViz."""

from setuptools import setup

NAME = "fgtrack_ros"

setup(
    name=NAME,
    version="0.2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/tracker.launch.py"]),
        (f"share/{NAME}/config", ["config/tracker.yaml"]),
        (f"share/{NAME}/rviz", ["rviz/tracker.rviz"]),
    ],
    install_requires=["setuptools", "fgtrack"],
    zip_safe=True,
    license="MIT",
    description="Tracks several objects from delayed object lists of several sensors.",
    entry_points={"console_scripts": [f"tracker = {NAME}.node:main"]},
)
