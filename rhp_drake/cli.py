"""The entry point of the command `rhp`."""

import sys

from rhp_drake.errors import InputError, WorkError


def main() -> None:
    """Runs the command, and ends with its exit status.

    Bad input is one sentence on stderr and exit status 2; Ctrl-C, where the command
    does not say more, is "Stopped." and 130.
    """
    try:
        # Imported here, for Ctrl-C may come meanwhile.
        from rhp_drake.commands.app import app

        app()
    except InputError as error:
        print(f"rhp: {error}", file=sys.stderr)
        sys.exit(2)
    except WorkError as error:
        print(f"rhp: {error}", file=sys.stderr)
        sys.exit(1)
    except (KeyboardInterrupt, ImportError, SystemExit) as error:
        if not _is_interrupt(error):
            raise
        print("Stopped.", file=sys.stderr)
        sys.exit(130)


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether an error comes of Ctrl-C.

    Extension modules make an ImportError of it, Typer a SystemExit.
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        context = None if error.__suppress_context__ else error.__context__
        error = error.__cause__ or context
    return error is not None


if __name__ == "__main__":
    main()
