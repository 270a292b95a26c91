"""Which versions of other packages are installed."""

from __future__ import annotations


def installed_version(package: str) -> str:
    """Returns a package's version; empty when it came without metadata.

    So come a checkout on the path, and Drake unpacked from its archive.
    """
    from importlib import metadata  # It brings a parser of e-mail headers.

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
