"""A Ray cluster of several machines on one: each in its own network, process and mount namespace (Linux, as root).

What is a machine to Ray shares no network address, no process, no ``/tmp/ray`` and no cache with the others; a switch
connects them. `Nodes.power_off` ends one with all its processes, `Nodes.cut` pulls its cable.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType

PORT = 6379
SWITCH = "harness-switch"
LONGEST_START_S = 120.0
HEAD = 0
TOKEN = "0123456789abcdef" * 4
"""By which machines of a cluster know each other."""


def missing() -> str | None:
    """What this machine lacks to play several; None if nothing."""
    if os.geteuid() != 0:
        return "not root"
    if lacking := [tool for tool in ("ip", "unshare", "nsenter", "mount") if shutil.which(tool) is None]:
        return f"no {', '.join(lacking)}"
    if subprocess.run(["unshare", "--mount", "--pid", "--net", "--fork", "true"], check=False).returncode:
        return "no namespaces here"
    return None


class Nodes:
    """``n`` machines of ``cpus`` workers' room each, of which the first is the cluster's head.

    Each keeps its cache in ``folder``; it begins with what is in the folder ``cache``, if one is given.
    """

    def __init__(self, folder: Path, n: int, *, cpus: int = 1, cache: Path | None = None) -> None:
        self._folder, self.n, self._cpus, self._cache = folder, n, cpus, cache
        self._running: dict[int, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Nodes:
        for k in range(self.n):
            _ip("netns", "del", self._name(k), check=False)
        _ip("netns", "del", SWITCH, check=False)
        try:
            self._connect()
            for k in range(self.n):
                self.power_on(k)
            self._wait_for_all()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for k in list(self._running):
            self.power_off(k)
        for name in [*map(self._name, range(self.n)), SWITCH]:
            _ip("netns", "del", name, check=False)

    def _name(self, k: int) -> str:
        return f"harness-node-{k}"

    @property
    def address(self) -> str:
        """Of the cluster."""
        return f"{_address(HEAD)}:{PORT}"

    def _connect(self) -> None:
        _ip("netns", "add", SWITCH)
        _ip("-n", SWITCH, "link", "add", "switch", "type", "bridge")
        _ip("-n", SWITCH, "link", "set", "switch", "up")
        for k in range(self.n):
            name = self._name(k)
            _ip("netns", "add", name)
            _ip("link", "add", "cable", "netns", name, "type", "veth", "peer", "name", f"port{k}", "netns", SWITCH)
            _ip("-n", SWITCH, "link", "set", f"port{k}", "master", "switch", "up")
            _ip("-n", name, "addr", "add", f"{_address(k)}/24", "dev", "cable")
            _ip("-n", name, "link", "set", "cable", "up")
            _ip("-n", name, "link", "set", "lo", "up")
            _ip("-n", name, "route", "add", "default", "dev", "cable")  # by it Ray finds its own address

    def power_on(self, k: int) -> None:
        """Start a machine, which joins the cluster."""
        home = self._folder / self._name(k)
        if not home.exists():
            home.mkdir(parents=True)
            if self._cache is not None:
                shutil.copytree(self._cache, home / "cache")
        ray = str(Path(sys.executable).parent / "ray")
        head = ["--head", f"--port={PORT}", "--include-dashboard=false"]
        joins = head if k == HEAD else [f"--address={self.address}"]
        start = [ray, "start", "--block", *joins, f"--node-ip-address={_address(k)}", f"--num-cpus={self._cpus}"]
        start += ["--object-store-memory=1000000000", "--disable-usage-stats"]
        script = 'mkdir -p /tmp/ray && mount -t tmpfs tmpfs /tmp/ray && exec "$@"'
        alone = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
        with (home / "log").open("ab") as log:
            self._running[k] = subprocess.Popen(
                ["ip", "netns", "exec", self._name(k), *alone, "bash", "-c", script, "node", *start],
                env=self._environment(k),
                cwd=home,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def _environment(self, k: int) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if not name.lower().endswith("_proxy")}
        home = self._folder / self._name(k)
        ours = {
            "HOME": str(home),
            "HARNESS_CACHE_DIR": str(home / "cache"),
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": TOKEN,
        }
        ours |= {"RAY_ADDRESS": self.address, "PYTHONPATH": str(Path(__file__).parents[1])}
        return {**kept, **ours}

    def command(self, *words: str, node: int = HEAD) -> list[str]:
        """A command that is carried out on a machine."""
        into = ["--net", "--mount", "--pid", f"--wd={Path.cwd()}"]
        return ["nsenter", f"--target={self.init(node)}", *into, *words]

    def start(
        self, *words: str, node: int = HEAD, stdout: int | None = None, stderr: int | None = None
    ) -> subprocess.Popen[bytes]:
        """Carry out a command on a machine."""
        return subprocess.Popen(
            self.command(*words, node=node), env=self._environment(node), stdout=stdout, stderr=stderr
        )

    def init(self, k: int) -> int:
        """First process of a machine."""
        unshare = self._running[k].pid
        until = time.monotonic() + 10.0
        while time.monotonic() < until and self._running[k].poll() is None:
            if children := Path(f"/proc/{unshare}/task/{unshare}/children").read_text().split():
                return int(children[0])
            time.sleep(0.05)
        raise RuntimeError(f"machine {k} does not start")

    def power_off(self, k: int) -> None:
        """End a machine at once, with everything on it."""
        process = self._running.pop(k)
        with suppress(ProcessLookupError, OSError, RuntimeError, IndexError):
            os.kill(
                int(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()[0]), signal.SIGKILL
            )
        process.kill()
        process.wait()

    def is_off(self, k: int) -> bool:
        """Whether a machine has ended by itself."""
        return self._running[k].poll() is not None

    def cut(self, k: int) -> None:
        """Pull the cable of a machine, which goes on."""
        _ip("-n", SWITCH, "link", "set", f"port{k}", "down")

    def mend(self, k: int) -> None:
        """Put the cable in again."""
        _ip("-n", SWITCH, "link", "set", f"port{k}", "up")

    def _wait_for_all(self) -> None:
        script = "import ray; ray.init(address='auto', logging_level='ERROR'); "
        script += "print(sum(node['Alive'] for node in ray.nodes()))"
        until = time.monotonic() + LONGEST_START_S
        while time.monotonic() < until and all(process.poll() is None for process in self._running.values()):
            asked = self.start(sys.executable, "-c", script, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
            said = asked.communicate()[0].split()
            if asked.returncode == 0 and int(said[-1]) == self.n:
                return
            time.sleep(0.5)
        logs = "\n".join((self._folder / self._name(k) / "log").read_text() for k in range(self.n))
        raise RuntimeError(f"the machines do not come together:\n{logs}")


def _address(k: int) -> str:
    return f"10.77.0.{k + 1}"


def _ip(*words: str, check: bool = True) -> None:
    subprocess.run(["ip", *words], check=check, capture_output=not check)
