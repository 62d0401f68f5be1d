"""The command line: ``python -m mapp_env COMMAND``."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from mapp_env.commands import main

if __name__ == "__main__":
    # `python -m` searches the working folder first, also for the libraries that are loaded later.
    home = str(Path(__file__).parents[1])
    if not sys.flags.safe_path and sys.path[0] == os.getcwd() != home:
        del sys.path[0]
    sys.exit(main())
