"""The command line's application: one-line errors, exit statuses, global options."""

from __future__ import annotations

import sys
import traceback
from typing import Annotated, Any, cast

import typer
from typer.core import TyperGroup

from vcbf_drake.environment import raise_on_interrupt, show_warnings_only

_FAILED, _BAD_USAGE, _INTERRUPTED = 1, 2, 130
# Click's class, wherever the installed typer keeps it.
_UsageError = cast(type[Exception], typer.BadParameter.__base__)


class OneLineGroup(TyperGroup):
    """Commands whose errors are one line on stderr and an exit status."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Runs the command line and exits."""
        kwargs["standalone_mode"] = False
        try:
            sys.exit(super().main(*args, **kwargs))
        except _UsageError as error:
            complain(error.format_message())  # type: ignore[attr-defined]
            sys.exit(_BAD_USAGE)
        except typer.Abort:
            complain("interrupted")
            sys.exit(_FAILED)
        except Exception as error:
            from vcbf_drake.errors import ModelError, ScenarioError

            if isinstance(error, ScenarioError | ModelError):
                complain(str(error))
                sys.exit(_BAD_USAGE)
            kind = type(error).__name__
            complain(f"{kind}: {error} (vcbf-drake --traceback ... shows where)")
            sys.exit(_FAILED)

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Reads the options; nothing at all asks for help."""
        return super().parse_args(ctx, args or ["--help"])

    def invoke(self, ctx: Any) -> Any:
        """Runs the command; with ``--traceback``, shows where it failed.

        Ctrl-C ends it with one line, after it has tidied up.
        """
        try:
            raise_on_interrupt()
            return super().invoke(ctx)
        except (_UsageError, typer.Exit):
            raise
        except KeyboardInterrupt:
            complain("interrupted")
            raise typer.Exit(_INTERRUPTED) from None
        except Exception:
            if ctx.params["show_traceback"]:
                traceback.print_exc()
            raise


def complain(message: str) -> None:
    """Says on stderr in one line what is wrong."""
    typer.echo(f"vcbf-drake: {' '.join(message.split())}", err=True)


app = typer.Typer(
    cls=OneLineGroup,
    add_completion=False,
    epilog="Exit status: 0 done, whatever became of the vehicle; 1 something failed;"
    " 2 bad usage or a bad scenario, told in one line. The commands plant and"
    " controller have more: see their help.",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("vcbf-drake"))
        raise typer.Exit


@app.callback()
def _options(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_show_version,
            is_eager=True,
            help="Show the version and exit.",
        ),
    ] = False,
    show_traceback: Annotated[
        bool,
        typer.Option(
            "--traceback", help="Show where an error comes from (before COMMAND)."
        ),
    ] = False,
) -> None:
    """Safety filters for Drake with a volume barrier, robust to disturbances."""
    show_warnings_only()
