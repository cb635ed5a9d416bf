"""``python -m napf_mpc``: the same as the command ``napf-mpc``."""

from napf_mpc.cli import main

if __name__ == "__main__":
    main()
