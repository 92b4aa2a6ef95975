"""Builds the distribution `dtsa` for `pip install .`: setuptools, with what the workspace's packages declare.

A setup.py at the top of the checkout would do the same, but colcon would take the checkout for one package.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from distutils.core import run_setup
from pathlib import Path

from setuptools import setup
from setuptools.build_meta import _BuildMetaBackend

PACKAGES = ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench")


class _Backend(_BuildMetaBackend):  # type: ignore[misc, unused-ignore]
    def run_setup(self, setup_script: str = "setup.py") -> None:
        """Call `setup()` with the packages, compiled modules and entry points of all three set-up scripts."""
        packages, folders, data, extensions, points = [], {}, {}, [], {}
        for name in PACKAGES:
            folder, top = Path("src", name), Path.cwd()
            os.chdir(folder)
            try:
                part = run_setup("setup.py", stop_after="config")
            finally:
                os.chdir(top)
            packages += part.packages
            folders |= {package: str(folder / package) for package in part.packages if "." not in package}
            data |= part.package_data
            for extension in part.ext_modules or ():
                for field in ("sources", "depends", "include_dirs"):
                    setattr(extension, field, [str(folder / path) for path in getattr(extension, field)])
                extensions.append(extension)
            points |= {group: entries for group, entries in part.entry_points.items() if group != "console_scripts"}
            nodes = [f"{name}.{entry}" for entry in part.entry_points["console_scripts"]]
            points["dtsa.nodes"] = [*points.get("dtsa.nodes", ()), *nodes]  # for `ros2 run`, not for the PATH
        build = tempfile.mkdtemp(prefix="dtsa-build-")
        atexit.register(shutil.rmtree, build, ignore_errors=True)
        setup(
            version=part.metadata.version,
            packages=packages,
            package_dir=folders,
            package_data=data,
            ext_modules=extensions,
            entry_points={**points, "console_scripts": ["dtsa = dtsa_bench.__main__:dtsa"]},
            options={"build": {"build_base": build}, "bdist_wheel": {"py_limited_api": "cp310"}},
            zip_safe=False,
        )


_backend = _Backend()
build_wheel, build_sdist, build_editable = _backend.build_wheel, _backend.build_sdist, _backend.build_editable
get_requires_for_build_wheel = _backend.get_requires_for_build_wheel
get_requires_for_build_sdist = _backend.get_requires_for_build_sdist
get_requires_for_build_editable = _backend.get_requires_for_build_editable
prepare_metadata_for_build_wheel = _backend.prepare_metadata_for_build_wheel
prepare_metadata_for_build_editable = _backend.prepare_metadata_for_build_editable
