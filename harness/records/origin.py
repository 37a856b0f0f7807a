"""Whether a run folder was made on this machine by this user: else a replay runs code that somebody else has named.

A key of the user's own signs each run's ``campaign.yaml``, which names the code. A folder that is moved keeps its
signature; one from elsewhere, or whose campaign was changed, has none of this key.
"""

from __future__ import annotations

import hmac
import os
import secrets
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import platformdirs

from harness.campaign.vehicle import AutomatedVehicle
from harness.errors import RunFolderError
from harness.files import read_bytes
from harness.records.folder import CAMPAIGN


def signature(campaign: bytes) -> str | None:
    """What a manifest says of its campaign, so that `require_trust` knows it again; None for a user without a home."""
    key = _key()
    return None if key is None else hmac.new(key, campaign, "sha256").hexdigest()


def code_of(av: AutomatedVehicle) -> str | None:
    """Code of the user's that a vehicle runs in processes of the harness; None if it is no such vehicle."""
    return av.controller or (None if av.fmu is None else av.fmu.file)


def require_trust(folder: Path, manifest: Mapping[str, Any], code: str | None, mend: str) -> None:
    """Refuse (`RunFolderError`) to run ``code`` that a folder names which this user has not made on this machine."""
    signed = signature(read_bytes(folder / CAMPAIGN))
    if code is not None and (signed is None or not hmac.compare_digest(signed, str(manifest.get("signature")))):
        found = f"a run that was not made on this machine by this user; it names {code}, which would be run"
        raise RunFolderError(str(folder), found, "a run of your own, or your word for that code", mend)


def _key() -> bytes | None:
    """The user's key, made when it is first asked for; None where there is no place for one."""
    with suppress(OSError, RuntimeError):  # nobody knows where this user is at home
        path = platformdirs.user_config_path("harness") / "key"
        if not path.is_absolute():  # so say older versions of that package
            return None
        unfinished = path.with_name(f".{uuid.uuid4().hex}.part")
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            unfinished.touch(0o600)
            unfinished.write_bytes(secrets.token_bytes(32))
            with suppress(FileExistsError):  # another process was faster
                path.hardlink_to(unfinished)
            unfinished.unlink()
        return path.read_bytes() if path.stat().st_uid == os.geteuid() else None
    return None
