"""The command ``napf-mpc``, also as ``python -m napf_mpc``."""

import os
from typing import NoReturn

from napf_mpc import interrupts


def main() -> NoReturn:
    """Run the command line and leave with its exit code: 0, 1 (not reached), 2 (bad input), 130 or 143."""
    interrupts.run(_command)


def _command() -> int:
    # No figure of a command needs a window, and matplotlib does not load with a backend that is not there.
    os.environ["MPLBACKEND"] = "agg"
    from napf_mpc.cli import run_command  # a stop while this loads is a clean one too

    return run_command()


if __name__ == "__main__":
    main()
