"""`python -m maexp.agents.cli`: the command `maexp`."""

import sys

from maexp.agents.cli import main

sys.exit(main())
