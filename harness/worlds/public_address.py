"""Whether strangers could reach this machine: SUMO's TraCI server listens on every address that it has.

SUMO 1.28 binds its server to INADDR_ANY and has no option for another address (its options about TraCI are
``--remote-port`` and ``--num-clients``). It serves the first clients that come, so that who is faster than the user's
program would be taken for it.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from pathlib import Path

from harness.campaign.vehicle import TraciProcess
from harness.errors import CampaignError

_ROUTES = Path("/proc/net/fib_trie")
_LOCAL = re.compile(r"^ *\|-- ([\d.]+)\n +/32 host LOCAL$", re.MULTILINE)


def own_addresses() -> set[str]:
    """IPv4 addresses of this machine's interfaces; without a ``/proc``, those that its name stands for."""
    try:
        return set(_LOCAL.findall(_ROUTES.read_text(encoding="ascii")))
    except OSError:
        try:
            return set(socket.gethostbyname_ex(socket.gethostname())[2])
        except OSError:
            return set()


def require_private(program: TraciProcess) -> None:
    """Refuse to open a TraCI server where the internet can reach it, unless the campaign says that this is right."""
    public = sorted(address for address in own_addresses() if ipaddress.ip_address(address).is_global)
    if public and not program.allow_public:
        raise CampaignError(
            "av.traci",
            f"a machine with the public address {public[0]}, on which SUMO's TraCI server would listen, too",
            "a machine with private addresses only: SUMO cannot be told to listen on this machine alone",
            "Run in a container or behind a firewall that closes all ports, then set av.traci.allow_public: true.",
        )
