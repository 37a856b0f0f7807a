"""Blocks of a stored run, shard by shard: what estimators are fed with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from harness.campaign.loading import load_campaign
from harness.errors import RunFolderError
from harness.estimators.block import Block
from harness.estimators.from_records import EPISODE_COLUMNS, MOMENT_COLUMNS, SHELL_COLUMNS, block_from_tables
from harness.importance.build import mixture_weights
from harness.pool.surrogate_replay import PATH_COLUMNS, SurrogateReplay
from harness.records.folder import SHELLS, no_episodes, read_json, read_manifest, require_schema
from harness.records.reader import read_shards
from harness.records.stored_manifest import StoredShells
from harness.strata import ShellDesign

_FINISH = "Run `harness run` with --resume, which makes missing shards."


def stored_blocks(
    folder: Path, *, moments: bool, surrogates: SurrogateReplay | None = None, n_asked: int = 0
) -> Iterator[Block]:
    """Blocks of the tests that count, in index order; a gap or too few of them is an error.

    Parameters
    ----------
    folder : Path
        Run folder with ``manifest.json``, ``campaign.yaml`` and shards.
    moments : bool
        Whether to read the ratios of control steps, which `scv` needs, where there are any on record.
    surrogates : SurrogateReplay, optional
        Surrogates to be asked about the shards that begin within the first ``n_asked`` tests.
    n_asked : int

    Raises
    ------
    HarnessError
        If the folder is not a run, or its records are damaged or incomplete.
    """
    campaign, n_counted = load_campaign(folder / "campaign.yaml", check_files=False), _n_counted(folder)
    method = campaign.testing.method
    shells = read_shells(folder) if method == "shells" else None
    columns = [*EPISODE_COLUMNS, *(SHELL_COLUMNS if shells else ()), *(PATH_COLUMNS if surrogates else ())]
    ratios = MOMENT_COLUMNS if moments and method == "step_mixture" else ()
    n = 0
    for episodes, steps in read_shards(
        folder, episode_columns=list(dict.fromkeys(columns)), moment_columns=list(ratios)
    ):
        block = block_from_tables(episodes, steps, method=method, alpha=mixture_weights(campaign), shells=shells)
        if surrogates is not None and n < n_asked:
            block = replace(block, surrogates_crash=surrogates.crashes(episodes), known_rates=surrogates.known)
        if block.first_episode != n:
            raise _incomplete(folder, f"a shard that begins at episode {block.first_episode}", f"episode {n}")
        counted = block.take(slice(0, n_counted - n))
        n += len(counted)
        yield counted
        if n == n_counted:
            return
    raise _incomplete(folder, f"{n} episodes on record", f"{n_counted} (manifest.json)")


def _n_counted(folder: Path) -> int:
    n_counted = int(read_manifest(folder)["n_episodes"])
    if n_counted == 0:
        raise no_episodes(folder)
    return n_counted


def read_shells(folder: Path) -> ShellDesign:
    """Strata of a shells campaign.

    Raises
    ------
    RunFolderError
        The file is missing or damaged.
    """
    path = folder / SHELLS
    content = read_json(path, mend=_FINISH)
    require_schema(content, StoredShells, path, mend=_FINISH)
    try:
        return ShellDesign.from_json(content)
    except (KeyError, TypeError, ValueError) as error:
        found = f"no complete description of shells ({error})"
        raise RunFolderError(str(path), found=found, expected="what the run has written", mend=_FINISH) from error


def _incomplete(folder: Path, found: str, expected: str) -> RunFolderError:
    return RunFolderError(str(folder), found=found, expected=expected, mend=_FINISH)
