"""Videos of failed episodes."""

import imageio.v2 as imageio
import numpy as np
import pytest
from short_protocols import shorten
from synthetic_results import of_protocol, outcome, write

from robocas_ms3.cli.eval import run
from robocas_ms3.cli.eval_results import Videos, videos
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.evaluation.policies.plain import RandomPolicy
from robocas_ms3.evaluation.policy import ExternalPolicy, PolicySpec
from robocas_ms3.evaluation.protocols.protocol import load_protocol
from robocas_ms3.evaluation.report.videos import SIZE, choose_episodes, record_videos
from robocas_ms3.evaluation.settings import EvaluationSettings


def test_failed_episodes_are_chosen_in_turn_per_failure_stage(tmp_path):
    came_to = [0, 0, 0, 3, 7, 3]
    table = [outcome(number, came) for number, came in enumerate(came_to)]
    result = write(tmp_path / "a", [*table, outcome(6, 0, config="heap")])
    assert choose_episodes(result, 2) == [0, 6]
    assert choose_episodes(result, 3) == [0, 3, 6]
    assert choose_episodes(result, 5) == [0, 1, 3, 5, 6]
    assert choose_episodes(result, 99) == [0, 1, 2, 3, 5, 6]
    assert choose_episodes(result, 9, "succeeded") == [4]
    assert choose_episodes(result, 99, "all") == [0, 1, 2, 3, 4, 5, 6]


def test_result_of_another_protocol_is_refused(tmp_path):
    result = of_protocol(tmp_path / "a", load_protocol("smoke"))
    result.run.protocol_hash = "0"
    with pytest.raises(EvaluationError, match="other files of the protocol"):
        next(record_videos(result, load_protocol("smoke"), RandomPolicy(), [0]))


def test_policy_gets_only_configurations_of_the_result_for_its_warnings(tmp_path, monkeypatch):
    protocol, found = load_protocol("paper-v1"), []

    class Specialist(ExternalPolicy):
        def protocol_warnings(self, configs) -> list[str]:
            found.extend((name, config.task) for name, config in configs.items())
            return []

    monkeypatch.setattr("robocas_ms3.evaluation.report.videos.require_renderer", lambda: None)
    config = "pick_upstream_eval"
    for task, played_as in (("pick", {}), ("select", {"select": "pick"})):
        outcomes = [outcome(0, task=task, config=config, split=protocol.episodes[0].split)]
        run = {"protocol": "paper-v1", "protocol_hash": protocol.hash, "played_as": played_as}
        result = write(tmp_path / task, outcomes, **run)
        assert not list(record_videos(result, protocol, Specialist(PolicySpec(reference="tcp", rate_hz=5)), []))
    assert found == [(config, "pick"), (config, "select")]


@pytest.mark.parametrize("installed", ["random", "small"])
def test_without_failed_episodes_no_video_is_recorded(tmp_path, capsys, installed):
    result = of_protocol(tmp_path / "b", load_protocol("smoke"))
    record = result.folder / "run.json"
    record.write_text(record.read_text().replace('"mine"', f'"{installed}"'))
    assert videos(Videos(result.folder)) == 0
    assert "no episode to record with --outcome failed" in capsys.readouterr().out


def test_a_policy_named_in_a_result_is_not_imported_without_confirmation(tmp_path, capsys):
    result = of_protocol(tmp_path / "b", load_protocol("smoke"))
    with pytest.raises(
        EvaluationError, match=r"the policy of this result has no registered name \(found mine\).*--policy mine"
    ):
        videos(Videos(result.folder))
    with pytest.raises(EvaluationError, match="mine: unknown policy"):  # confirmed
        videos(Videos(result.folder, policy="mine"))


@pytest.mark.slow
def test_video_of_a_failed_episode_is_recorded_and_linked(tmp_path, needs_renderer, capsys):
    out, protocol = tmp_path / "result", str(shorten("paper-v1", tmp_path / "tiny", 2, episodes=1))
    assert run(EvaluationSettings((), "random", protocol, out, backend="processes", weld=True)) == 0
    assert videos(Videos(out, protocol=protocol)) == 0
    said = capsys.readouterr().out
    assert "episode_00000.mp4" in said and "differs" not in said
    frames = np.stack([np.asarray(frame) for frame in imageio.get_reader(out / "videos" / "episode_00000.mp4")])
    assert frames.shape == (3, SIZE[1], SIZE[0], 3)  # at the reset, after each of 2 steps
    assert frames.std() > 10
    page = (out / "report.html").read_text()
    assert 'href="videos/episode_00000.mp4"' in page and "1 of 1 episode, protocol" in page
