"""Commands on the page name the run folder so that they can be pasted, and say nothing of the machine."""

from __future__ import annotations

import shutil

import pytest
from test_report_page import page_of

from harness.report import write_report
from harness.report.run_folder import typed_folder


def test_a_folder_below_the_working_directory_is_named_by_its_path(reports, tmp_path, monkeypatch):
    shutil.copytree(reports["no_traces"], tmp_path / "runs/my run")
    monkeypatch.chdir(tmp_path)
    write_report(tmp_path / "runs/my run")
    page = page_of(tmp_path / "runs/my run")
    assert "harness replay 'runs/my run' " in page.text
    assert "harness run 'runs/my run'/campaign.yaml --out again" in page.text
    assert str(tmp_path) not in page.text


def test_any_other_folder_goes_by_its_name_and_the_page_says_what_that_is(reports):
    text = " ".join(page_of(reports["full"]).text.split())
    assert "harness report run " in text
    assert "run is the folder (DIR) that this page lies in" in text
    assert str(reports["full"].parent) not in text


@pytest.mark.parametrize(("typed", "shown"), [("runs/a", "runs/a"), ("runs/../runs/a/", "runs/a"), ("link", "link")])
def test_typed_folder(typed, shown, tmp_path, monkeypatch):
    (tmp_path / "here/runs/a").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "here/link").symlink_to(tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path / "here")
    assert typed_folder(tmp_path / "here" / typed) == shown
    assert typed_folder(tmp_path / "elsewhere") == "elsewhere"
    assert typed_folder(tmp_path / "here") == "."
