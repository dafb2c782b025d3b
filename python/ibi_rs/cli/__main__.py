"""`python -m ibi_rs.cli`."""

import sys

from . import app

sys.exit(app())
