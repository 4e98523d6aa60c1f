"""Each change of a result is found by the check that is expected for it, or by none."""

import importlib
import json
from pathlib import Path

import pytest

from robocas_ms3.evaluation.results.run_record import get_package_versions

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
VERIFIED = {"protocol", "protocol_hash", "weld", "pack_hashes.builtin"}
AUDITED = {"backend", *(f"policy.spec.{name}" for name in ("convention", "reference", "rate_hz"))}
VERSIONS = {f"versions.{name}" for name in get_package_versions()}
STATEMENTS = {
    *("policy.name", "policy.class", "policy.spec.track", "policy.spec.calibration", "policy.spec.state"),
    *("policy.data.name", "policy.data.hash", "policy.data.episodes", "policy.data.samples", "policy.trained_in"),
    *("policy.steps", "policy.training_seconds", "policy.hardware", "policy.parameters", "policy.weights"),
    *("policy.init_from", "policy.trained_with.torch", "policy.config.train.seed"),
    *("training_differences.pick_upstream_eval.0", "training_differences.search_upstream_eval.0", "machine.model"),
}
"""Some of the values in ``run.json`` of a trained policy that no check finds."""


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("tampering")


def test_most_values_of_a_trained_policy_are_statements_of_the_author(tmp_path, script):
    found_by = {one.change.removeprefix("run.json "): one.found_by for one in script.check_trained_fields(tmp_path)}
    assert set(found_by.values()) == {"verify", "none"}
    assert {name for name, check in found_by.items() if check == "verify"} == VERIFIED
    statements = found_by.keys() - VERIFIED - AUDITED - VERSIONS
    assert statements >= STATEMENTS
    assert all(name.startswith(("policy.", "training_differences.", "machine.")) for name in statements)


def test_at_least_20_forgeries_are_consistent_and_expected_by_verify_or_audit(script):
    found_by = [one.found_by for one in script.FORGERIES.values() if one.is_consistent]
    assert found_by.count("verify") + found_by.count("audit") >= 20
    assert {"verify", "audit"} <= set(found_by)


@pytest.mark.parametrize(
    ("value", "key"),
    [
        ("2.13.0+cpu", "versions.torch"),
        ("0" * 64, "hash"),
        ("end-to-end", "track"),
        ({}, "cameras"),
        (True, "weld"),
        (None, "p_vis"),
        ([], "moved"),
    ],
)
def test_changed_value_differs(script, value, key):
    values = {key: value}
    script.change_value(values, (key,))
    assert values[key] != value


def test_changed_version_differs_without_its_local_part(script):
    assert script.change_text("2.13.0+cpu") == "2.14.0+cpu"


@pytest.mark.slow
def test_forgeries_are_found_by_the_expected_checks(tmp_path, capsys, script):
    script.main(script.Benchmark(tmp_path, fields=False))  # ends with an error if a check differs
    printed = json.loads(capsys.readouterr().out)
    found = printed["found"]["forgeries"]
    assert sum(found.values()) == len(script.FORGERIES)
    assert printed["consistent"] >= 20
    assert {one["change"] for one in printed["forgeries"] if one["found_by"] == "none"} == {
        "repeated line of an episode",  # changes nothing
        "deleted states",  # an audit then needs equal outcomes; the leaderboard refuses such a result
        "another policy",
    }
