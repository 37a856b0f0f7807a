"""Check that a wheel holds every module and data file of the checkout: the list of packages is written by hand."""

import sys
from pathlib import Path
from zipfile import ZipFile

DATA = {".yaml", ".j2", ".css", ".js", ".xml", ".typed", ".py"}
NOT_SHIPPED = {Path("sumo_networks/rebuild.py")}


def expected() -> set[str]:
    """Names in the wheel of all files that an installed harness needs."""
    found = set()
    for folder, inside in (("harness", "harness"), ("sumo_networks", "harness/sumo_networks")):
        for path in Path(folder).rglob("*"):
            if path.suffix in DATA and path not in NOT_SHIPPED:
                found.add(f"{inside}/{path.relative_to(folder).as_posix()}")
    found.add("harness/scenarios/av_panel.yaml")
    return found


def main(wheel: str) -> int:
    """Compare; returns the exit code."""
    with ZipFile(wheel) as archive:
        names = set(archive.namelist())
    missing = sorted(expected() - names)
    if not any(name.endswith("/licenses/LICENSE") for name in names):
        missing.append("LICENSE")
    for name in missing:
        print(f"{Path(wheel).name} lacks {name}", file=sys.stderr)  # noqa: T201
    print(f"{Path(wheel).name}: {len(names)} files, {len(missing)} missing")  # noqa: T201
    return int(bool(missing))


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
