"""Expert interventions: the state of the first policy is taken over completely, and the recording is valid."""

from __future__ import annotations

import hashlib
from typing import ClassVar

import h5py
import numpy as np
import pytest

from robocas_ms3.baselines.training.record import BUNDLED, hash_weights
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.datasets.checks.replay import replay_dataset
from robocas_ms3.datasets.conversion.convert import convert
from robocas_ms3.datasets.conversion.settings import ConversionSettings
from robocas_ms3.datasets.sources.reader import Dataset
from robocas_ms3.demos.failures import Intervention
from robocas_ms3.demos.generator import EpisodeGenerator
from robocas_ms3.demos.recordings.trajectory_file import TrajectoryFile
from robocas_ms3.demos.recordings.trajectory_json import read_json
from robocas_ms3.demos.settings import EpisodeSettings, ReplaySettings
from robocas_ms3.demos.trajectory_replay import replay
from robocas_ms3.evaluation.policies.plain import NoopPolicy
from robocas_ms3.evaluation.policies.replay import ReplayPolicy
from robocas_ms3.evaluation.policy import EpisodeSpec, PolicySpec
from robocas_ms3.evaluation.rollouts.policy_rollin import PolicyRollIn, check_roll_in_policy, sample_roll_in_steps

CONFIG = "pick_upstream_eval"


class SidePolicy(NoopPolicy):
    """Policy that observes a camera that the configuration lacks."""

    spec = PolicySpec(reference="tcp", cameras={"side_camera": (64, 48)})


class OneRobotPolicy(NoopPolicy):
    """Policy that records its episodes and controls no robot but the one named in ``robot``."""

    spec = PolicySpec(reference="tcp")
    robot = "another_robot"
    episodes: ClassVar[list[EpisodeSpec]] = []

    def check_robot(self, robot):
        if robot != self.robot:
            raise EvaluationError("this policy cannot control the robot", where=robot)

    def reset(self, episodes):
        self.episodes += episodes
        super().reset(episodes)


def settings(policy: str, steps: tuple[int, int]) -> EpisodeSettings:
    return EpisodeSettings("pick", CONFIG, "builtin", after_policy=policy, after_steps=steps)


@pytest.fixture
def roll_in(request):
    made = PolicyRollIn(settings(*request.param))
    yield made
    made.close()


@pytest.fixture(scope="module")
def generator():
    made = EpisodeGenerator(settings("random", (1, 1)))
    yield made
    made.close()


@pytest.fixture(scope="module")
def recorded(generator, tmp_path_factory):
    """Return a recording after 31 random steps, its initial state, and the TCP position in the arm's base."""
    folder, roll_in = tmp_path_factory.mktemp("recorded"), PolicyRollIn(settings("random", (31, 31)))
    intervention = roll_in.run(2)
    tcp = roll_in._base.agent.tcp_in_arm_base.p[0].numpy().copy()
    roll_in.close()
    assert generator.generate(2, folder, "one", intervention).success
    return folder / "one.h5", intervention, tcp


def numbers(node, name=""):
    if not hasattr(node, "items"):
        return {name: np.asarray(node)}
    return {key: value for inner, of in node.items() for key, value in numbers(of, f"{name}/{inner}").items()}


@pytest.mark.slow
def test_policy_knows_the_motion_steps_of_the_rules():
    made = PolicyRollIn(settings(f"{__name__}:OneRobotPolicy", (1, 1)))
    made.run(2)
    made.close()
    (episode,) = OneRobotPolicy.episodes
    assert episode.motion_steps == 2  # a policy moves the arm with two control steps per action, as in paper-v1


def test_number_of_steps_is_drawn_from_the_seed_with_both_ends():
    assert sample_roll_in_steps(5, (7, 7)) == 7
    drawn = [sample_roll_in_steps(seed, (5, 8)) for seed in range(60)]
    assert set(drawn) == {5, 6, 7, 8}
    assert drawn == [sample_roll_in_steps(seed, (5, 8)) for seed in range(60)]


def test_weights_have_a_hash_and_unsupported_actions_are_an_error():
    with pytest.raises(EvaluationError, match="joint_positions"):
        check_roll_in_policy(settings("scripted", (5, 60)))
    with pytest.raises(EvaluationError, match="unknown camera.*side_camera"):
        check_roll_in_policy(settings(f"{__name__}:SidePolicy", (5, 60)))
    with pytest.raises(EvaluationError, match="cannot control the robot"):
        check_roll_in_policy(settings(f"{__name__}:OneRobotPolicy", (5, 60)))
    assert check_roll_in_policy(settings("random", (5, 60))) == ""
    assert check_roll_in_policy(settings("small", (5, 60))) == hash_weights(BUNDLED / "small")


@pytest.mark.parametrize("roll_in", [("random", (12, 12))], indirect=True)
def test_state_after_the_policy_depends_on_the_seed_only(roll_in):
    first = roll_in.run(3)
    other = roll_in.run(4)
    again = roll_in.run(3)
    assert first.policy_steps == again.policy_steps == 12
    assert not first.skip_reason
    ours, theirs = numbers(first.state), numbers(again.state)
    assert ours.keys() == theirs.keys()
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
    assert not np.array_equal(ours["/actors/object_0"], numbers(other.state)["/actors/object_0"])


@pytest.mark.parametrize("roll_in", [("scripted-ee-delta", (90, 90))], indirect=True)
def test_seed_is_skipped_if_the_policy_succeeded(roll_in, generator, tmp_path):
    intervention = roll_in.run(4)
    assert intervention.skip_reason == "succeeded"
    assert intervention.policy_steps < 90
    result = generator.generate(4, tmp_path, "one", intervention)
    assert not result.success
    assert [(failure.stage, failure.reason) for failure in result.failures] == [("intervention", "succeeded")]
    died = Intervention(7, "random", 0, {}, 1.0, "SIGSEGV")
    (failure,) = generator.generate(7, tmp_path, "one", died).failures
    assert (failure.stage, failure.reason) == ("intervention", "SIGSEGV")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_recording_starts_in_the_state_of_the_policy(recorded, generator, tmp_path):
    one, intervention, _ = recorded
    assert intervention.gripper == -1.0
    assert generator.generate(2, tmp_path, "two", intervention).success
    two = tmp_path / "two.h5"
    assert parse_actions(one) == parse_actions(two)
    with h5py.File(one) as file:
        group = file["traj_0"]
        for name, left in numbers(intervention.state).items():
            assert np.array_equal(group[f"env_states{name}"][0], left[0]), name
        arm = group["env_states/articulations/robocas_mobile_panda"][:, 13 + 3 : 13 + 10]
        assert np.abs(np.diff(arm[:5], axis=0)).max() < 0.02  # rad per step: the arm stops without a jump
        commands = group["actions"][:, 7]
        assert (commands[:4] == -1).all()  # 0.2 s
        assert commands[4] == 1  # nothing was held
    (episode,) = read_json(one)["episodes"]
    assert episode["robocas"]["intervention"] == {"policy": "random", "policy_steps": 31}
    assert episode["robocas"]["subgoals"][0]["goal_range"][0] == 0
    assert [(played.success, played.state_error) for played in replay(ReplaySettings(one))] == [(True, 0.0)]
    saved = tmp_path / "saved.h5"
    assert [played.success for played in replay(ReplaySettings(one, use_env_states=True, save=saved))] == [True]
    assert parse_actions(saved) == parse_actions(one)
    with TrajectoryFile(saved) as file:
        assert file.read_entry(0).is_intervention
    with pytest.raises(EvaluationError, match="cannot replay expert interventions"):
        ReplayPolicy(one)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("roll_in", "subgoals", "commands"),
    [
        (
            ("scripted-ee-delta", (31, 31)),
            ["transfer object"],
            1,
        ),  # the target is held: it opens above the basket
        # same scene, perturbed grasp: it opens, closes at the target, and opens above the basket
        (("scripted-perturbed", (31, 31)), ["move and grasp", "transfer object"], 3),
    ],
    indirect=["roll_in"],
)
def test_intervention_continues_with_the_held_object(roll_in, generator, tmp_path, subgoals, commands):
    intervention = roll_in.run(2)
    assert intervention.gripper == -1.0
    assert generator.generate(2, tmp_path, "one", intervention).success
    (episode,) = read_json(tmp_path / "one.h5")["episodes"]
    assert [part["goal_type"] for part in episode["robocas"]["subgoals"]] == subgoals
    with h5py.File(tmp_path / "one.h5") as file:
        gripper = file["traj_0/actions"][:, 7]
    assert np.flatnonzero(np.diff(gripper)).size == commands
    assert gripper[0] == -1


@pytest.mark.slow
def test_intervention_is_converted_from_its_first_state(recorded, tmp_path, needs_renderer):
    recording, _, tcp = recorded
    settings = {"cameras": ("base_camera",), "size": (64, 48), "depth": False, "embeddings": False, "video": False}
    convert(ConversionSettings(recording, tmp_path / "dataset", **settings))
    report = replay_dataset(tmp_path / "dataset")
    assert report.episodes[0].success is None
    assert "another policy" in report.episodes[0].skipped
    first = Dataset(tmp_path / "dataset").episode(0).arrays["ee_pos"][0]
    np.testing.assert_allclose(first, tcp, atol=1e-5)


def parse_actions(path) -> str:
    with h5py.File(path) as file:
        return hashlib.sha256(file["traj_0/actions"][()].tobytes()).hexdigest()
