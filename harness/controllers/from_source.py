"""The user's modules are compiled from their sources, as these are now.

Python's own cache (``__pycache__``) goes by a source's size and its time stamp in seconds: where both are the same, as
of versions that are copied, restored or edited within a second, it runs code that is no longer there.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES, ExtensionFileLoader, FileFinder, SourceFileLoader
from pathlib import Path
from sysconfig import get_path
from types import CodeType

_NOT_THE_USERS = str(Path(__file__).parents[1]), get_path("stdlib"), get_path("platstdlib")


class FromSource(SourceFileLoader):
    """Loads a module, whatever has been kept of an earlier one."""

    def get_code(self, fullname: str) -> CodeType:
        """The code of the file."""
        path = self.get_filename(fullname)
        code: CodeType = self.source_to_code(self.get_data(path), path)
        return code


def is_users(folder: str) -> bool:
    """Whether what lies in a folder is neither installed there nor the harness itself."""
    return "-packages" not in folder and not folder.startswith(_NOT_THE_USERS)


def import_from(folder: Path) -> None:
    """Let modules of a folder be imported; from here on all that are not installed are, from their sources."""
    if _finder not in sys.path_hooks:
        sys.path_hooks.insert(0, _finder)
        sys.path_importer_cache.clear()
    if (here := str(folder)) not in sys.path:
        sys.path.insert(0, here)


def _finder(path: str) -> FileFinder:
    """As a hook of ``sys.path_hooks``."""
    path = path or os.getcwd()  # noqa: PTH109 - as Python's own
    if not is_users(path) or not os.path.isdir(path):  # noqa: PTH112
        raise ImportError(path)
    return FileFinder(path, (ExtensionFileLoader, EXTENSION_SUFFIXES), (FromSource, SOURCE_SUFFIXES))
