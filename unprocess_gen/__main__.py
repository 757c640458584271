"""``python -m unprocess_gen`` is ``gen-dataset``."""

import sys

from unprocess_gen.cli.main import main

sys.exit(main())
