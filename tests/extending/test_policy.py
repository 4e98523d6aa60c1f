"""A policy of a stranger's package, as docs/extending.md has it: installed beside this one, nothing touched in it."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import pytest
from strangers import robocas

from robocas_ms3.cli.list import collect
from robocas_ms3.core.errors import EvaluationError, ExtensionError
from robocas_ms3.core.extensions import Registry
from robocas_ms3.evaluation import policies, results
from robocas_ms3.evaluation.policies import GROUP, make_policy
from robocas_ms3.evaluation.protocol import load_protocol

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8").split("## A policy\n")[1].split("\n## ")[0]


def block(language: str) -> str:
    """The page's block of code in a language."""
    (code,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    return code


def install(site: Path, package: str, module: str, entries: str) -> Path:
    """Do as pip does: a module and its package's metadata in a folder of packages."""
    about = site / f"{package.replace('-', '_')}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{GROUP}]\n{entries}\n")
    (site / f"{package.replace('-', '_')}.py").write_text(module)
    return site


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder of packages in which that of the page is."""
    *_, header, entry = block("toml").splitlines()
    assert header == f'[project.entry-points."{GROUP}"]'
    folder = install(tmp_path / "site", "my-policies", block("python"), entry.replace('"', ""))
    monkeypatch.syspath_prepend(folder)
    for name in ("my_policies", "spoilt_policies", "rival_policies"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    builtin = policies.POLICIES
    table = Registry(builtin.kind, builtin.group, builtin.type, builtin.builtin)
    monkeypatch.setattr(policies, "POLICIES", table)  # as if the process had begun now
    return folder


def test_it_is_found_and_listed_by_its_name(site):
    assert type(make_policy("descend")).__module__ == "my_policies"
    listed = {row["name"]: row for row in collect()["policies"]}
    assert listed["descend"] == {"name": "descend", "package": "my-policies", "of": "my_policies:Descend"}
    assert {"scripted", "scripted-motions", "random", "still"} <= listed.keys()
    with pytest.raises(EvaluationError, match="no such policy .*Did you mean descend"):
        make_policy("decend")


@pytest.mark.parametrize(
    ("module", "entry", "message"),
    [
        (
            "import not_there_at_all",
            "it = spoilt_policies:It",
            "it = .*not_there_at_all.*uninstall spoilt-policies",
        ),
        ("def (", "it = spoilt_policies:It", "it = .*: this policy can't be loaded .*SyntaxError"),
        ("", "it = spoilt_policies:It", "it = .*: this policy can't be loaded .*no attribute 'It'"),
        ("", "it = nowhere_at_all:It", "it = .*: this policy can't be loaded .*No module named 'nowhere_at_all'"),
        ("It = 7", "it = spoilt_policies:It", "it = .*: not a policy .*found int"),
        ("def It(size): ...", "it = spoilt_policies:It", "it: this policy can't be made .*takes no arguments"),
        ("It = object", "it = spoilt_policies:It", "it: a policy without spec"),
    ],
)
def test_a_broken_one_is_one_line_and_only_when_it_is_chosen(site, module, entry, message):
    install(site, "spoilt-policies", module, entry)
    assert "it" in {row["name"] for row in collect()["policies"]}
    assert type(make_policy("descend")).__name__ == "Descend"
    with pytest.raises((EvaluationError, ExtensionError), match=message) as caught:
        make_policy("it")
    assert "\n" not in str(caught.value)


def test_names_are_nobodys_to_take(site):
    install(site, "rival-policies", "", "descend = rival_policies:Mine\nstill = rival_policies:Mine")
    assert type(make_policy("still")).__module__ == "robocas_ms3.evaluation.policies.plain"
    with pytest.raises(ExtensionError, match="descend: several packages have .*my-policies.*rival-policies"):
        make_policy("descend")


@pytest.mark.slow
def test_it_is_measured_by_its_name(site, tmp_path):
    protocol = tmp_path / "short"
    shutil.copytree(load_protocol("smoke").folder, protocol)
    rules = protocol / "protocol.yaml"
    rules.write_text(rules.read_text().replace("max_steps: null", "max_steps: 3"))
    (line,) = [line for line in block("bash").splitlines() if "eval" in line]
    command = line.replace("robocas eval", "eval").replace("smoke", str(protocol)).split()
    robocas(site, *command, "--backend", "processes", "--envs", 1, cwd=tmp_path)
    result = results.read(tmp_path / "eval" / "descend")
    assert result.run.policy.name == "descend"
    assert result.run.policy.model_dump()["class"] == "my_policies:Descend"
    (outcome,) = result.outcomes.values()
    assert (outcome.task, outcome.error, outcome.steps) == ("pick", "", 3)
