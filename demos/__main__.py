"""`python -m demos` is `mixed-fem`."""

from __future__ import annotations

import sys

from demos.entry import main

sys.exit(main())
