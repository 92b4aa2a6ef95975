"""Build of dtsa_agent: Python packages, the compiled kernel of the protocol core, executables, plugins."""

import re
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from cffi import FFI, recompiler
from setuptools import Extension, find_packages, setup

NAME = "dtsa_agent"

# The same bits on every x86_64 machine: nothing here may reorder, contract or approximate floating-point
# operations, and nothing may depend on the machine that compiles. -fno-math-errno and -fno-trapping-math
# change no result: sqrt becomes one instruction, and comparisons may be computed without branches.
COMPILE_FLAGS = [
    "-std=c11",
    "-O3",
    "-fno-fast-math",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fvisibility=hidden",
    "-Wno-psabi",  # vectors are passed between inlined functions only
]

LIBRARY, SIMULATOR, SOCKETS = "dtsa_agent/libdtsa", "dtsa_agent/libdtsa_sim", "dtsa_agent/air"
# What Python sees of both: all that these headers declare, in the order in which they include each other.
HEADERS = [
    f"{LIBRARY}/{name}.h" for name in ("include/dtsa", "include/dtsa_station", "frame", "core", "avoider/avoider")
]
HEADERS += [f"{SIMULATOR}/{name}.h" for name in ("vehicle", "course", "swarm", "metrics", "run", "live")]
HEADERS += [f"{SOCKETS}/socket_reader.h"]
# What C calls in Python: an agent behind a station, and what is told of it (core/station.py).
CALLBACKS = "dtsa_agent/core/callbacks.h"


def files(suffix: str, folders: tuple[str, ...] = (LIBRARY, SIMULATOR, SOCKETS)) -> list[str]:
    """Sources of the compiled part with a suffix: one agent, many agents, what reads from a socket."""
    return [path for folder in folders for path in sorted(glob(f"{folder}/**/*{suffix}", recursive=True))]


def binding() -> str:
    """Write the C code by which Python calls what HEADERS declare (cffi, limited API); return its path."""
    text = "\n".join(Path(header).read_text(encoding="utf-8") for header in HEADERS)
    text += f'extern "Python" {{ {Path(CALLBACKS).read_text(encoding="utf-8")} }}'
    text = re.sub(r"/\*.*?\*/|#ifdef __cplusplus.*?#endif", "", text, flags=re.DOTALL)
    text = re.sub(r"^#define (DTSA_VERSION) (\d+)$", r"enum { \1 = \2 };", text, flags=re.MULTILINE)
    text = re.sub(r"^#.*$|\bDTSA_API\b", "", text, flags=re.MULTILINE)
    ffi = FFI()
    ffi.cdef(text, override=True)  # one function may stand in two headers
    path = Path("build/binding/_kernel.c")
    path.parent.mkdir(parents=True, exist_ok=True)
    includes = "".join(f'#include "{Path(header).name}"\n' for header in HEADERS)
    recompiler.make_c_source(ffi, "dtsa_agent.core._kernel", includes, str(path))  # a file that is right stays
    return str(path)


setup(
    name=NAME,
    version=ElementTree.parse("package.xml").findtext("version"),
    packages=find_packages(exclude=["test", "test.*"]),
    ext_modules=[
        Extension(
            "dtsa_agent.core._kernel",
            sources=[binding(), *files(".c")],
            depends=[*files(".h"), "setup.py"],
            include_dirs=[f"{LIBRARY}/include", f"{LIBRARY}/avoider", LIBRARY, SIMULATOR, SOCKETS],
            extra_compile_args=COMPILE_FLAGS,
            py_limited_api=True,  # cffi's code says so, too: one compiled file for Python 3.10 and later
            libraries=["m"],
        ),
        Extension(
            "dtsa_agent.ros.common._endless",
            sources=["dtsa_agent/ros/common/_endless.c"],
            py_limited_api=True,
        ),
    ],
    package_data={NAME: ["py.typed", "**/*.pyi", "**/*.yaml", "**/*.xml", "**/*.[ch]"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *([(f"share/{NAME}/config", sorted(glob("config/*.yaml")))] if glob("config/*.yaml") else []),
        *([(f"share/{NAME}/launch", sorted(glob("launch/*.py")))] if glob("launch/*.py") else []),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # tells `colcon test` what runs the tests
    options={"bdist_wheel": {"py_limited_api": "cp310"}},
    zip_safe=False,
    maintainer="DTSA maintainers",
    maintainer_email="maintainers@dtsa.example",
    description="One quadcopter of a swarm that shares a radio channel: core, ROS nodes, bridge.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "agent = dtsa_agent.ros.agent_node:main",
            "swarm_host = dtsa_agent.ros.swarm_host:main",
            "crazyflie_bridge = dtsa_agent.crazyflie.node.bridge_node:main",
            "crazyflie_agents = dtsa_agent.crazyflie.node.agents_node:main",
        ],
    },
)
