"""This process's surroundings: Drake's log, and the versions of packages."""

from __future__ import annotations

import logging


def show_warnings_only() -> None:
    """Restricts Drake's printed log to warnings and errors.

    A solver's own messages serve the debugging of solvers. A filter is used because
    importing pydrake resets the log's level.
    """
    logging.getLogger("drake").addFilter(_is_warning)


def _is_warning(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.WARNING


def installed_version(package: str) -> str:
    """Returns a package's version; empty when it came without metadata.

    So come a checkout on the path, and Drake unpacked from its archive.
    """
    from importlib import metadata  # It brings a parser of e-mail headers.

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
