"""Which versions of other packages are installed."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def installed_version(package: str) -> str:
    """Returns a package's version; empty when it came without metadata.

    So come a checkout on the path, and Drake unpacked from its archive.
    """
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
