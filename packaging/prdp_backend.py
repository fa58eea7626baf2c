"""The build backend: setuptools', with the torch that the compiled library is to run with.

A compiled library works with the version of torch that it was built against, and with no other. An isolated build would
get the newest one; this one takes the torch of the environment that pip installs into.
"""

import re
import site
import sys
import sysconfig
from importlib.machinery import PathFinder
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403  the hooks that stay as they are

ROOT = Path(__file__).resolve().parents[1]


def find_torch():
    """The folder and the version of the torch to build against, or None. Looks in the environment behind an isolated
    build, too, from which nothing can be imported there."""
    behind = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib"), *site.getsitepackages()}
    found = PathFinder.find_spec("torch", [*sys.path, *sorted(behind), site.getusersitepackages()])
    if found is None or found.origin is None:
        return None
    folder = Path(found.origin).parent
    return folder, re.search(r"^__version__ = '(.+)'", (folder / "version.py").read_text(), re.MULTILINE)[1]


def requirement():
    """What the package asks for: exactly the torch that it was built against, be it for the CPU or for CUDA."""
    torch = find_torch()
    return f"torch=={torch[1].partition('+')[0]}" if torch else "torch"


def _tested_torch():
    return re.search(r"^torch==\S+", (ROOT / "requirements.txt").read_text(), re.MULTILINE)[0]


def get_requires_for_build_wheel(config_settings=None):
    return [] if find_torch() else [_tested_torch()]


get_requires_for_build_editable = get_requires_for_build_wheel


def prepare_metadata_for_build_wheel(folder, config_settings=None):
    _check_torch()  # before pip looks for other requirements
    return build_meta.prepare_metadata_for_build_wheel(folder, config_settings)


def prepare_metadata_for_build_editable(folder, config_settings=None):
    _check_torch()
    return build_meta.prepare_metadata_for_build_editable(folder, config_settings)


def _check_torch():
    if not find_torch():
        sys.exit(
            "prdp_torch: this environment has no torch to build against; leave out --no-build-isolation, or first "
            f"pip install {_tested_torch()}"
        )
