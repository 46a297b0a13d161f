"""What `colcon build` installs."""

from pathlib import Path

from setuptools import setup

NAME = "fmu_mesh_ros"

setup(
    name=NAME,
    version="0.3.0",
    description="Executables, launch files and a launch action for fmu_mesh.",
    license="Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(map(str, Path("launch").glob("*.launch.py")))),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    entry_points={
        "console_scripts": [f"{name} = {NAME}.executables:{name}" for name in ("gateway", "mesh", "node", "wait")],
    },
)
