"""Build of dtsa_channel_sim: the simulated radio channel and its node."""

from glob import glob

from setuptools import find_packages, setup

NAME = "dtsa_channel_sim"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={NAME: ["py.typed", "**/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *([(f"share/{NAME}/config", sorted(glob("config/*.yaml")))] if glob("config/*.yaml") else []),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # tells `colcon test` what runs the tests
    zip_safe=False,
    maintainer="DTSA maintainers",
    maintainer_email="maintainers@dtsa.example",
    description="The radio channel that a swarm shares: slots, collisions, losses, ranges, clocks.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["channel = dtsa_channel_sim.ros.channel_node:main"]},
)
