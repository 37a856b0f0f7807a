"""Python files of the user's: what one holds, told without running it, and how it is imported.

It is compiled from its source, as this is now. Python's own cache (``__pycache__``) goes by a source's size and its
time stamp in seconds: where both are the same, as of a version edited within a second, it runs code that is gone.
"""

from __future__ import annotations

import ast
import os
import sys
from contextlib import suppress
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES, ExtensionFileLoader, FileFinder, SourceFileLoader
from pathlib import Path
from sysconfig import get_path
from types import CodeType

TRACI_MODULES = "traci", "libsumo", "libtraci"
NOT_THE_USERS = str(Path(__file__).parents[1]), get_path("stdlib"), get_path("platstdlib")
"""Where the harness itself lies, and Python."""


def file_and_function(name: str) -> tuple[str, str]:
    """The parts of ``file.py:main``; the function is empty in ``file.py``, or any other name."""
    file, colon, function = name.partition(".py:")
    return (f"{file}.py", function) if colon else (name, "")


def _parsed(name: str) -> ast.Module | None:
    """A Python file; None where it is not there, and one without content where it is not Python."""
    file = Path(name)
    if file.suffix != ".py" or not file.is_file():
        return None
    with suppress(SyntaxError, ValueError), file.open("rb") as source:
        return ast.parse(source.read())  # which knows of other encodings, as Python does
    return ast.Module([], [])


def is_script(name: str) -> bool:
    """Whether it is a TraCI script that runs as it is: a file that imports traci, or its function without arguments.

    A file that is not Python counts as one, so that running it says where it is wrong.
    """
    file, function = file_and_function(name)
    if (tree := _parsed(file)) is None:
        return False
    if tree.body and not any(name.partition(".")[0] in TRACI_MODULES for name in _imports(tree)):
        return False
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name == function:
            args = node.args
            required = len(args.posonlyargs) + len(args.args) - len(args.defaults) + args.kw_defaults.count(None)
            return required == 0 and (node.returns is None or ast.unparse(node.returns) == "None")
    return not function


def _imports(tree: ast.Module) -> set[str]:
    """Modules that are imported anywhere, and names taken from them, which may be modules; relative ones with dots."""
    modules = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            start = "." * node.level + (f"{node.module}." if node.module else "")
            modules.update(start + alias.name for alias in node.names)
    return modules


def files_imported(file: Path, root: Path) -> set[Path]:
    """A Python file, and all below the importable folder ``root`` that it imports, directly or not."""
    files, new = set[Path](), {file}
    while new:
        files.add(current := new.pop())
        for name in _imports(_parsed(str(current)) or ast.Module([], [])):
            absolute = name.lstrip(".")
            below = [root, *current.parents][: len(name) - len(absolute) + 1][-1].joinpath(*absolute.split("."))
            for place in (below, *below.parents):
                if not place.is_relative_to(root) or place in (root, root / "harness"):
                    break
                new |= {each for each in (place.with_suffix(".py"), place / "__init__.py") if each.is_file()} - files
    return files


def in_python_file(text: str) -> str:
    """Advice which class or function of a Python file may be meant; empty if it is none."""
    if (tree := _parsed(text)) is None:
        return ""
    definitions = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    drive = [name for name, n in definitions.items() if isinstance(n, ast.FunctionDef) or "step" in ast.dump(n)]
    shown = ([name for name in drive if name[0] != "_"] or list(definitions))[:6]
    return f"Name its class or function: {' or '.join(f'{text}:{name}' for name in shown)}." if shown else ""


# -- imported --


class FromSource(SourceFileLoader):
    """Loads a module, whatever has been kept of an earlier one."""

    def get_code(self, fullname: str) -> CodeType:
        """The code of the file."""
        path = self.get_filename(fullname)
        code: CodeType = self.source_to_code(self.get_data(path), path)
        return code


def is_users(folder: str) -> bool:
    """Whether what lies in a folder is neither installed there nor the harness itself."""
    return "-packages" not in folder and not folder.startswith(NOT_THE_USERS)


def import_from(folder: Path) -> None:
    """Let modules of a folder be imported; from here on all that are not installed are, from their sources."""
    if _finder not in sys.path_hooks:
        sys.path_hooks.insert(0, _finder)
        sys.path_importer_cache.clear()
    if (here := str(folder)) not in sys.path:
        sys.path.insert(0, here)


def _finder(path: str) -> FileFinder:
    path = path or os.getcwd()  # noqa: PTH109 - as Python's own
    if not is_users(path) or not os.path.isdir(path):  # noqa: PTH112
        raise ImportError(path)
    return FileFinder(path, (ExtensionFileLoader, EXTENSION_SUFFIXES), (FromSource, SOURCE_SUFFIXES))
