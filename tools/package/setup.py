"""Build of the distribution `dtsa` out of the set-up scripts of the workspace's packages: nothing is said twice."""

import os
from distutils.core import run_setup
from pathlib import Path

from setuptools import setup

PACKAGES = ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench")
COMMAND = "dtsa"  # on the PATH; nodes are for `ros2 run`


def described(name):
    """What a package's own set-up script says, with paths from here."""
    folder, here = Path("src") / name, Path.cwd()
    os.chdir(folder)
    try:
        said = run_setup("setup.py", stop_after="init")
    finally:
        os.chdir(here)
    for extension in said.ext_modules or ():
        extension.sources = [str(folder / path) for path in extension.sources]
        extension.depends = [str(folder / path) for path in extension.depends]
        extension.include_dirs = [str(folder / path) for path in extension.include_dirs]
    return folder, said


packages, package_dir, package_data, extensions, entry_points = [], {}, {}, [], {}
for folder, said in map(described, PACKAGES):
    packages += said.packages
    package_dir |= {name: str(folder / name) for name in said.packages if "." not in name}
    package_data |= said.package_data
    extensions += said.ext_modules or []
    for group, entries in said.entry_points.items():
        kept = entries if group != "console_scripts" else [e for e in entries if e.split(" =")[0] == COMMAND]
        entry_points.setdefault(group, []).extend(kept)

setup(
    version=said.metadata.version,
    packages=packages,
    package_dir=package_dir,
    package_data=package_data,
    ext_modules=extensions,
    entry_points=entry_points,
    options={"bdist_wheel": {"py_limited_api": "cp310"}},
    zip_safe=False,
)
