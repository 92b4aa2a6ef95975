"""Build of dtsa_bench: commands, figures, launch files."""

from glob import glob

from setuptools import find_packages, setup

NAME = "dtsa_bench"
ASSETS = ["html", "js", "css", "json", "yaml", "svg"]

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={
        NAME: [
            "py.typed",
            *(f"**/*.{suffix}" for suffix in ASSETS),
            "native/*.[chl]*",
            "**/*.LICENSE",
            "new_plugin/files/*.in",
        ],
        "dtsa": ["py.typed"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *([(f"share/{NAME}/launch", sorted(glob("launch/*.py")))] if glob("launch/*.py") else []),
        *([(f"share/{NAME}/config", sorted(glob("config/*.yaml")))] if glob("config/*.yaml") else []),
        *([(f"share/{NAME}/rviz", sorted(glob("rviz/*")))] if glob("rviz/*") else []),
        *([(f"share/{NAME}/urdf", sorted(glob("urdf/*")))] if glob("urdf/*") else []),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # tells `colcon test` what runs the tests
    zip_safe=False,
    maintainer="DTSA maintainers",
    maintainer_email="maintainers@dtsa.example",
    description="Flights, experiments and their analysis: simulate, fly, record, replay, verify, report.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "dtsa = dtsa_bench.entry:dtsa",
            "recorded_channel = dtsa_bench.entry:recorded_channel",
            "fake_crazyflie = dtsa_bench.entry:fake_crazyflie",
        ],
        "dtsa.policies": [
            "genie-age = dtsa_bench.schemes:GenieAge",
            "genie-error = dtsa_bench.schemes:GenieError",
            "dominance = dtsa_bench.schemes:Dominance",
            "event-tdma = dtsa_bench.schemes:EventTdma",
            "sense = dtsa_bench.schemes:Sense",
            "sotdma = dtsa_bench.schemes:Sotdma",
            "threshold-aloha = dtsa_bench.schemes:ThresholdAloha",
            "pure-aloha = dtsa_bench.schemes:PureAloha",
            "beacons = dtsa_bench.schemes:Beacons",
            "csma = dtsa_bench.schemes:Csma",
            "dtr = dtsa_bench.schemes:Dtr",
            "whittle = dtsa_bench.schemes:Whittle",
        ],
    },
)
