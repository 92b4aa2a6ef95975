"""The compiled core: what the headers of libdtsa and libdtsa_sim declare, by cffi (see ``setup.py``)."""

from typing import Any

ffi: Any
lib: Any
