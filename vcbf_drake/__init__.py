"""Drake systems for robust safety filters with a volume barrier.

The public names stand in ``__init__.pyi``, each with the module it comes from. Type
checkers read them there; here a name is loaded when it is first used, so that importing
the package costs nothing.
"""

from __future__ import annotations

__version__ = "0.1.0"

_HOMES: dict[str, str] = {}


def _homes() -> dict[str, str]:
    """Returns the module that each public name comes from, as the stub has it."""
    if not _HOMES:
        import ast
        from pathlib import Path

        stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
        for node in ast.parse(stub).body:
            if isinstance(node, ast.ImportFrom):
                home = f"{__name__}.{node.module}"
                _HOMES.update({alias.name: home for alias in node.names})
    return _HOMES


def __getattr__(name: str) -> object:
    if name == "__all__":
        return sorted(_homes())
    if name not in _homes():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = globals()[name] = getattr(import_module(_homes()[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_homes()})
