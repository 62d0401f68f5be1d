"""The command line: ``python -m mapp_env COMMAND``."""

from __future__ import annotations

import sys

from mapp_env.commands import main

if __name__ == "__main__":
    sys.exit(main())
