"""Run ``gen-dataset`` as ``python -m unprocess_gen``."""

import sys

from unprocess_gen.cli.main import main

sys.exit(main())
