"""Build of dtsa_bench: commands, figures, launch files."""

from glob import glob

from setuptools import find_packages, setup

NAME = "dtsa_bench"
ASSETS = ["html", "js", "css", "json", "yaml", "svg", "c", "h"]

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={
        NAME: [
            "py.typed",
            *(f"**/*.{suffix}" for suffix in ASSETS),
            "**/*.in",
            "**/*.msg",
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
        "dtsa.recorders": ["agent = dtsa_bench.recordings.merge.agent_recorder:recorded"],
        "dtsa.policies": [
            "genie-age = dtsa_bench.simulation.schemes:GenieAge",
            "genie-error = dtsa_bench.simulation.schemes:GenieError",
            "dominance = dtsa_bench.simulation.schemes:Dominance",
            "event-tdma = dtsa_bench.simulation.schemes:EventTdma",
            "sense = dtsa_bench.simulation.schemes:Sense",
            "sotdma = dtsa_bench.simulation.schemes:Sotdma",
            "threshold-aloha = dtsa_bench.simulation.schemes:ThresholdAloha",
            "pure-aloha = dtsa_bench.simulation.schemes:PureAloha",
            "beacons = dtsa_bench.simulation.schemes:Beacons",
            "csma = dtsa_bench.simulation.schemes:Csma",
            "dtr = dtsa_bench.simulation.schemes:Dtr",
            "mixer = dtsa_bench.simulation.schemes:Mixer",
            "threshold-aoii = dtsa_bench.simulation.schemes:ThresholdAoii",
            "whittle = dtsa_bench.simulation.schemes:Whittle",
        ],
    },
)
