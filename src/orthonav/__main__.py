"""`python -m orthonav`."""

import sys

from orthonav.cli import main

sys.exit(main())
