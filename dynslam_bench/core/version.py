"""The version of this package: that of the installed distribution, which its build takes from git's tags."""

import re
from functools import cache

UNKNOWN = "0+unknown"
"""The version of a checkout that is not installed; see `core.fingerprint.git_revision`."""


@cache
def version() -> str:
    """For example ``0.1.0``, or ``0.1.1.dev5+g1a2b3c4`` five commits after the tag ``v0.1.0``."""
    from importlib import metadata

    try:
        return metadata.version("dynslam-bench")
    except metadata.PackageNotFoundError:
        return UNKNOWN


def install_hint(extra: str) -> str:
    """The command that installs one of this package's extras: from the checkout, since it is on no index yet."""
    return f"pip install '.[{extra}]' in the checkout of dynslam-bench"


def release() -> str:
    """The release that the version belongs to, three numbers such as ``0.1.0``: the same for all its development.

    Runs and cached stages are identified by it and by the code itself, not by the number of
    commits.
    """
    match = re.match(r"\d+(?:\.\d+)*", version())
    numbers = match[0].split(".") if match else []
    return ".".join([*numbers, "0", "0", "0"][:3])
