"""Where each value of a YAML document was written, for messages that name the line."""

from __future__ import annotations

from collections.abc import Sequence

from yaml.nodes import MappingNode, Node, SequenceNode

YamlPath = Sequence[str | int]


def dotted(where: YamlPath) -> str:
    """``testing.alpha``, the way a path is written in messages and after ``--set``."""
    return ".".join(map(str, where))


class Lines:
    """Where each value of a YAML document was written.

    Parameters
    ----------
    path : str
        Name of the document, for messages.
    root : Node or None
        Document, composed and constructed; None when nothing is known, which places every value on line 1.
    """

    def __init__(self, path: str, root: Node | None = None) -> None:
        self.path = path
        self._root = root

    def line_of(self, where: YamlPath) -> int:
        """Line, from 1, of the value at ``where``, or of its nearest ancestor that is in the file."""
        node, line = self._root, 1
        for part in where:
            found = _child(node, part)
            if found is None:
                break
            mark, node = found
            line = mark.start_mark.line + 1
        return line

    def place(self, where: YamlPath) -> str:
        """``testing.alpha (smoke.yaml:12)``, or just file and line for the whole document."""
        spot = f"{self.path}:{self.line_of(where)}"
        return f"{dotted(where)} ({spot})" if where else spot


def _child(node: Node | None, part: str | int) -> tuple[Node, Node] | None:
    """Node that marks the line, and node of the value, of one step into ``node``."""
    if isinstance(node, SequenceNode) and isinstance(part, int) and part < len(node.value):
        return node.value[part], node.value[part]
    if isinstance(node, MappingNode):
        # The loader has put what ``<<`` merges before the mapping's own keys, which override it.
        return next(((key, value) for key, value in reversed(node.value) if key.value == str(part)), None)
    return None
