"""Rebuild the committed networks with SUMO's netconvert (extra ``harness[sumo]``): ``python sumo_networks/rebuild.py``.

A cell is a straight two-lane road of its own, so cells cannot influence each other. ``highway-1`` holds one road, for
looking at an episode in sumo-gui; ``highway-256`` holds 256 of them, for campaigns: roads without vehicles cost
nothing.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import sumo

HERE = Path(__file__).parent
ROAD_LENGTH_M = 4000
"""Longer than the start (100 m + gaps) plus what any vehicle can drive in 20 s at SUMO's limit of 100 m/s."""
SPEED_LIMIT_MPS = 100
SPACING_M = 12


def plain_xml(n_cells: int) -> tuple[str, str]:
    """Nodes and edges of ``n_cells`` parallel roads."""
    nodes, edges = [], []
    for k in range(n_cells):
        y = -SPACING_M * k
        nodes.append(f'  <node id="from{k}" x="0" y="{y}"/>\n  <node id="to{k}" x="{ROAD_LENGTH_M}" y="{y}"/>\n')
        edges.append(
            f'  <edge id="cell{k}" from="from{k}" to="to{k}" numLanes="2" speed="{SPEED_LIMIT_MPS}" '
            f'spreadType="center"/>\n'
        )
    return f"<nodes>\n{''.join(nodes)}</nodes>\n", f"<edges>\n{''.join(edges)}</edges>\n"


def rebuild(n_cells: int) -> Path:
    """Write ``highway-<n>.net.xml``."""
    target = HERE / f"highway-{n_cells}.net.xml"
    nodes, edges = plain_xml(n_cells)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "cells.nod.xml").write_text(nodes)
        (Path(folder) / "cells.edg.xml").write_text(edges)
        command = [f"{sumo.SUMO_HOME}/bin/netconvert", "-n", "cells.nod.xml", "-e", "cells.edg.xml", "-o", str(target)]
        command += ["--no-turnarounds", "true", "--output.street-names", "false", "--no-warnings", "true"]
        subprocess.run(command, cwd=folder, check=True)  # noqa: S603
    text = target.read_text()
    begin, end = text.index("<!--"), text.index("-->") + 3  # the comment holds the date and this machine's paths
    target.write_text(text[:begin] + text[end:].lstrip("\n"))
    return target


if __name__ == "__main__":
    for size in (1, 256):
        print(rebuild(size))  # noqa: T201
