"""Give Hydra applications the option files: ``hydra.searchpath: [pkg://unprocess_gen.conf]``.

Importing this package stores the schema, which ``config.yaml`` needs, in Hydra's ConfigStore.
"""

from importlib.resources.abc import TraversableResources
from importlib.resources.readers import MultiplexedPath
from pathlib import Path

from unprocess_gen.config import composition as composition
from unprocess_gen.config.option_files import conf_dir


class OptionFiles(TraversableResources):
    """Resources of this package: files of `conf_dir`, which in a source tree is next to ``unprocess_gen``."""

    def files(self) -> MultiplexedPath:
        """Option files, and the ``__init__.py`` by which Hydra knows a package."""
        return MultiplexedPath(conf_dir(), Path(__file__).parent)


__spec__.loader.get_resource_reader = lambda name: OptionFiles()  # type: ignore[union-attr]
