"""What a test of a shells run stands for: its shell's probability over the number of tests in that shell."""

from __future__ import annotations

import numpy as np

from harness.errors import RunFolderError
from harness.report.fine_histogram import Floats
from harness.report.run_folder import RunFolder
from harness.report.shard_tables import episode_batches

COMPONENT = "component"


def log_scales(run: RunFolder) -> Floats:
    """Logarithm of 1/n_s per shell, shape (S,): it turns recorded weights p_s into ones that add up to probabilities.

    A record carries log p_s, because it is written before anybody knows how many tests its shell will get. Weights
    p_s/n_s add up to Σ p_s c_s; weights p_s would count a shell as often as it was tested. A shell without tests has
    scale 0, and no test to use it.

    Raises
    ------
    RunFolderError
        If a shard is damaged, or a test belongs to no shell.
    """
    counts = np.zeros(0, np.int64)
    for batch in episode_batches(run, (COMPONENT,)):
        shell = batch.column(COMPONENT).to_numpy(zero_copy_only=False).astype(np.int64)
        if (shell < 0).any():
            raise RunFolderError(
                str(run.path / "episodes"),
                found="a test without shell (component -1)",
                expected="the shell that each test was drawn from",
                mend="The records are not those of a run with testing.method shells: run the campaign again.",
            )
        here = np.bincount(shell, minlength=counts.size)
        counts = here + np.pad(counts, (0, here.size - counts.size))
    scales: Floats = -np.log(np.maximum(counts, 1))
    return scales
