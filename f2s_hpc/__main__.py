"""``python -m f2s_hpc``: the same as the ``f2s`` command."""

from f2s_hpc.cli.main import entry

entry()
