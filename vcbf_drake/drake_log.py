"""Drake's log: what a solver says of itself is for whoever debugs solvers."""

from __future__ import annotations

import logging


def show_warnings_only() -> None:
    """Keeps all but warnings and errors of Drake's log from being printed.

    By a filter, for importing pydrake sets the log's level anew.
    """
    logging.getLogger("drake").addFilter(_is_warning)


def _is_warning(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.WARNING
