"""This process's surroundings: Drake's log, and the versions of packages."""

from __future__ import annotations

import logging


def show_warnings_only() -> None:
    """Keeps all but warnings and errors of Drake's log from being printed.

    A solver's own messages are for whoever debugs solvers. By a filter, for importing
    pydrake sets the log's level anew.
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
